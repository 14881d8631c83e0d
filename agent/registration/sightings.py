"""Which detections may be sightings of a MAV, and by it, and what pose do they give?

A detection m of a placed MAV b and a detection n of j may be each other's sighting if their ranges agree and their
elevations are opposite. Then j's pose follows in closed form:

    psi_j = psi_b + az_m + pi - az_n,      p_j = p_b + r u(psi_b + az_m, el)

Detectors that do not look all around may see no one by whom they are seen. There m alone gives p_j, if it is no
sighting of a MAV that is placed; and n, as the sighting of another placed MAV c, gives the yaw:

    psi_j = az(p_c - p_j) - az_n
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.interface.frames import Array, direction, range_and_bearing
from agent.registration import views
from agent.registration.window import Frame, carried

if TYPE_CHECKING:
    from agent.registration.candidates import Placement

RANGE_GATE, ELEVATION_GATE = 3.2, 3.5  # standard deviations of the two readings' difference
SEEN = 16.0  # squared normalised residual below which a detection is that of a placed MAV
Index = npt.NDArray[np.intp]


@dataclass
class Sightings:
    """Pairs of detections, one of the MAV and one by it, each with the pose it gives."""

    mav: Index
    base: Index  # the placed MAV, by its rank among them
    frame: Index
    poses: Array  # (S, 4)
    bearing: Array  # (S, 2) azimuth in the common frame, elevation: from the placed MAV
    distance: Array  # (S,)


def joined(parts: list[Sightings]) -> Sightings:
    return Sightings(*(np.concatenate([getattr(each, n) for each in parts]) for n in Sightings.__annotations__))


def reciprocal(config: AgentConfig, k: int, frames: list[Frame], base: "Placement", missing: list[int]) -> Sightings:
    """In frame k: of the MAVs in `missing` and those of `base`, each other's; poses at the newest frame."""
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
    return Sightings(mav, rank, np.full(len(mav), k), poses, np.column_stack([azimuth, elevation]), distance)


def one_way(config: AgentConfig, k: int, frames: list[Frame], base: "Placement", missing: list[int]) -> Sightings:
    """In frame k: of the MAVs in `missing` by those of `base`, and of others of `base` by them; as `reciprocal`."""
    frame, newest, detector = frames[k], frames[-1], config.detector
    placed = np.flatnonzero(base.placed)
    others = np.array([j for j in missing if frame.heard[j]], np.intp)
    there = carried(base.poses[placed], newest.odometry[placed], frame.odometry[placed])
    b, im = _unexplained(config, frame, placed, there)
    z_m = frame.spherical[placed[b], im]
    bearing = np.column_stack([there[b, 3] + z_m[:, 1], z_m[:, 2]])
    places = there[b, :3] + z_m[:, :1] * direction(bearing[:, 0], bearing[:, 1])
    line = range_and_bearing(there[:, :3] - places[:, None])[:, None, :, None]  # (P, 1, C, 1, 3) to all placed
    n = frame.spherical[others][None, :, None]  # (1, J, 1, M, 3)
    sigma_m = detector.range_sigma_m(z_m[:, 0])[:, None, None, None]
    agree = np.abs(line[..., 0] - n[..., 0]) < RANGE_GATE * np.hypot(sigma_m, detector.range_sigma_m(n[..., 0]))
    # The place is as far off along the line of sight as the range is.
    tilt = np.sin(bearing[:, 1])[:, None, None, None] * sigma_m / np.maximum(line[..., 0], views.NEAREST_M)
    agree &= np.abs(line[..., 2] - n[..., 2]) < ELEVATION_GATE * np.hypot(np.sqrt(2) * detector.bearing_sigma_rad, tilt)
    agree &= (np.arange(len(placed)) != b[:, None])[:, None, :, None]
    p, j, c, jn = agree.nonzero()
    mav = others[j]
    yaw = line[p, 0, c, 0, 1] - frame.spherical[mav, jn, 1]
    poses = carried(np.column_stack([places[p], yaw]), frame.odometry[mav], newest.odometry[mav])
    return Sightings(mav, b[p], np.full(len(mav), k), poses, bearing[p], z_m[p, 0])


def _unexplained(config: AgentConfig, frame: Frame, placed: Index, there: Array) -> tuple[Index, Index]:
    """Detections of the placed MAVs, at these poses (B, 4), that are of none of them: whose (rank), and which."""
    spherical = range_and_bearing(there[None, :, :3] - there[:, None, :3])
    yaw = np.broadcast_to(there[:, 3:], spherical.shape[:2])
    sets = np.where(frame.heard[placed, None, None], frame.spherical[placed], np.nan)
    square = views.residuals(spherical, yaw, sets[:, None]).square(views.noise(config.detector, spherical[..., 0]))
    square[np.arange(len(placed)), np.arange(len(placed))] = np.inf
    b, m = (np.isfinite(sets[..., 0]) & ~(square < SEEN).any(axis=1)).nonzero()
    return b, m
