"""Where might a MAV be? Candidates from sightings of it and by it (`sightings.py`), clustered over frames.

It works in hover, from one instant; the MAV's odometry carries its pose to the newest frame, where those of all frames
are clustered.
"""

import math
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.interface.frames import Array, compose, direction, inverse, wrap
from agent.registration import sightings
from agent.registration.sightings import Sightings
from agent.registration.window import Frame

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


def candidates(
    config: AgentConfig, frames: list[Frame], base: Placement, missing: list[int]
) -> Generator[float, None, Candidates]:
    """Of the MAVs in `missing`, as seen from and seeing those of `base`; yields what it has just cost."""
    found = [sightings.reciprocal(config, k, frames, base, missing) for k in range(len(frames))]
    if not config.detector.sees_all_around:
        found += [sightings.one_way(config, k, frames, base, missing) for k in range(len(frames))]
    every = sightings.joined(found)
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


def _clustered(
    config: AgentConfig, every: Sightings, mine: npt.NDArray[np.bool_], frames: int, most: int
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
