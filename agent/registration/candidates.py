"""Where might a MAV be? Candidates from reciprocal sightings, clustered over frames.

A detection m of a placed MAV b and a detection n of j may be each other's sighting if their ranges agree and their
elevations are opposite. Then j's pose follows in closed form:

    psi_j = psi_b + az_m + pi - az_n,      p_j = p_b + r u(psi_b + az_m, el)

It works in hover, from one instant; j's odometry carries it to the newest frame, where the candidates of all frames
are clustered.
"""

import math
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.interface.frames import Array, compose, direction, inverse, wrap
from agent.registration.window import Frame, carried

RANGE_GATE, ELEVATION_GATE = 3.2, 3.5  # standard deviations of the two readings' difference
LEAST_SUPPORT = 2  # distinct frames
PER_MAV, MOST = 2, 24  # candidates of one MAV that are kept: so many per MAV of the team, at most so many
ENOUGH = 600  # sightings of one MAV: where there are more, as in a regular formation, not all placed MAVs are asked


@dataclass
class Placement:
    """Poses of some MAVs at the newest frame, in the station's odometry frame."""

    poses: Array  # (N, 4)
    covariances: Array  # (N, 4, 4), each MAV on its own
    placed: npt.NDArray[np.bool_]  # (N,)


def seen_from_station(placement: Placement, frame: Frame) -> Placement:
    """The same, moved so that the station is where its odometry says."""
    poses = placement.poses
    move = compose(frame.odometry[0], inverse(poses[0]))
    moved = compose(np.repeat(move[None], len(poses), axis=0), poses)
    return Placement(moved, placement.covariances, placement.placed)


@dataclass
class Candidates:
    """Of one or several MAVs, C in all."""

    mav: npt.NDArray[np.intp]  # (C,) index
    poses: Array  # (C, 4) at the newest frame
    covariances: Array  # (C, 4, 4)


@dataclass
class _Sightings:
    """Reciprocal pairs of detections, each with the pose it gives."""

    mav: npt.NDArray[np.intp]
    base: npt.NDArray[np.intp]  # the placed MAV, by its rank among them
    frame: npt.NDArray[np.intp]
    poses: Array  # (S, 4)
    bearing: Array  # (S, 2) azimuth in the common frame, elevation: from the placed MAV
    distance: Array  # (S,)


def candidates(
    config: AgentConfig, frames: list[Frame], base: Placement, missing: list[int]
) -> Generator[float, None, Candidates]:
    """Of the MAVs in `missing`, as seen from and seeing those of `base`; yields what it has just cost."""
    found = [_reciprocal(config, k, frames, base, missing) for k in range(len(frames))]
    every = _Sightings(*(np.concatenate([getattr(f, n) for f in found]) for n in _Sightings.__annotations__))
    clusters = []
    for j in missing:
        mine = every.mav == j
        every_so_many = max(1, math.ceil(mine.sum() / ENOUGH))
        mine &= every.base % every_so_many == 0
        clusters.append(_clustered(config, every, mine, len(frames), min(PER_MAV * len(base.placed), MOST)))
        yield 4000.0 + 0.9 * float(mine.sum()) ** 2
    return Candidates(
        np.repeat(missing, [len(poses) for poses, _ in clusters]).astype(np.intp),
        np.concatenate([poses for poses, _ in clusters]),
        np.concatenate([covariances for _, covariances in clusters]),
    )


def _reciprocal(config: AgentConfig, k: int, frames: list[Frame], base: Placement, missing: list[int]) -> _Sightings:
    frame, newest, detector = frames[k], frames[-1], config.detector
    bases = np.flatnonzero(base.placed & frame.heard)
    others = np.array([j for j in missing if frame.heard[j]], np.intp)
    there = carried(base.poses[bases], newest.odometry[bases], frame.odometry[bases])
    m, n = frame.spherical[bases][:, None, :, None], frame.spherical[others][None, :, None, :]
    sigma_m, sigma_n = detector.range_sigma_m(m[..., 0]), detector.range_sigma_m(n[..., 0])
    agree = np.abs(m[..., 0] - n[..., 0]) < RANGE_GATE * np.hypot(sigma_m, sigma_n)
    agree &= np.abs(m[..., 2] + n[..., 2]) < ELEVATION_GATE * np.sqrt(2) * detector.bearing_sigma_rad
    b, j, im, jn = agree.nonzero()
    z_m, z_n = frame.spherical[bases[b], im], frame.spherical[others[j], jn]
    # Both ranges measure one distance: weighted by their precision.
    w_m, w_n = detector.range_sigma_m(z_m[:, 0]) ** -2, detector.range_sigma_m(z_n[:, 0]) ** -2
    distance = (w_m * z_m[:, 0] + w_n * z_n[:, 0]) / (w_m + w_n)
    azimuth, elevation = there[b, 3] + z_m[:, 1], (z_m[:, 2] - z_n[:, 2]) / 2
    poses = np.empty((len(b), 4))
    poses[:, :3] = there[b, :3] + distance[:, None] * direction(azimuth, elevation)
    poses[:, 3] = azimuth + np.pi - z_n[:, 1]
    mav = others[j]
    poses = carried(poses, frame.odometry[mav], newest.odometry[mav])
    rank = (np.cumsum(base.placed) - 1)[bases[b]]
    return _Sightings(mav, rank, np.full(len(mav), k), poses, np.column_stack([azimuth, elevation]), distance)


def _clustered(
    config: AgentConfig, every: _Sightings, mine: npt.NDArray[np.bool_], frames: int, most: int
) -> tuple[Array, Array]:
    """(C, 4) and (C, 4, 4): greedily the poses that those of most frames agree in, of these sightings (S,)."""
    poses, frame, distance = every.poses[mine], every.frame[mine], every.distance[mine]
    line = direction(every.bearing[mine, 0], every.bearing[mine, 1])
    sigma, bearing = config.detector.range_sigma_m(distance), config.detector.bearing_sigma_rad
    apart = poses[None, :, :3] - poses[:, None, :3]
    along = np.abs((apart * line[:, None]).sum(-1))
    across = np.sqrt(np.maximum((apart**2).sum(-1) - along**2, 0))
    turn = np.abs(wrap(poses[None, :, 3] - poses[:, None, 3]))
    near = (along < 3 * sigma[:, None]) & (across < (0.1 + 4 * distance * bearing)[:, None]) & (turn < 0.07)
    in_frame = np.zeros((len(poses), frames))
    in_frame[np.arange(len(poses)), frame] = 1.0
    free = np.ones(len(poses), bool)
    means: list[Array] = []
    covariances: list[Array] = []
    while len(means) < most and free.any():
        support = ((near & free).astype(float) @ in_frame > 0).sum(1) * free
        best = int(support.argmax())
        if support[best] < LEAST_SUPPORT:
            break
        members = near[best] & free
        free &= ~members
        mean = poses[members].mean(0)
        mean[3] = poses[best, 3] + wrap(poses[members, 3] - poses[best, 3]).mean()
        means.append(mean)
        covariances.append(_covariance(config, line[best], float(distance[best]), float(support[best]), frames))
    return np.reshape(means, (-1, 4)), np.reshape(covariances, (-1, 4, 4))


def _covariance(config: AgentConfig, line: Array, distance: float, support: float, frames: int) -> Array:
    """Of a cluster: along the line of sight, across it, and of yaw; with the drift over the frames."""
    along = float(config.detector.range_sigma_m(np.array(distance))) ** 2 / (2 * support)
    bearing = config.detector.bearing_sigma_rad**2
    across = distance**2 * bearing / support
    drift = frames * config.odometry.position_sigma_m**2
    covariance = np.zeros((4, 4))
    covariance[:3, :3] = (across + drift) * np.eye(3) + (along - across) * np.outer(line, line)
    covariance[3, 3] = 2 * bearing / (support * max(1 - line[2] ** 2, 1e-2)) + frames * config.odometry.yaw_sigma_rad**2
    return covariance
