"""Which MAVs does each MAV see, and how exactly? Anonymous range-and-bearing detections with false ones among them."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.fleet import Fleet
from agent.interface.frames import Array, direction, range_and_bearing, rotation_matrix
from agent.interface.seeds import generator
from agent.interface.sensors import Detector
from world.poses import Poses

LEAST_RANGE_M = 0.01  # a measured range is positive, whatever its noise


class DetectionSet(NamedTuple):
    """What one MAV's detector reports, and (not for agents) what it really was."""

    spherical: Array  # (M, 3) range m, azimuth rad, elevation rad, in the rolled and pitched body frame
    labels: npt.NDArray[np.uint8]  # (M,) MAV 1..N, or 0 for a false detection


class Detectors:
    """The detectors of all MAVs; each has its own stream of random numbers."""

    def __init__(self, detector: Detector, fleet: Fleet) -> None:
        self._detector = detector
        self._ids = np.arange(1, fleet.mavs + 1, dtype=np.uint8)
        self._generators = [generator(fleet.seed, f"detector/{mav}") for mav in fleet.ids]

    def detect(self, true: Poses) -> list[DetectionSet]:
        """One set per MAV, in random order, from the true poses in the world."""
        mavs = len(self._ids)
        apart = true.position[None] - true.position[:, None]  # (N, N, 3): [i, j] from i to j
        seen_from = range_and_bearing(apart @ rotation_matrix(true.quaternion))  # v @ R = R^T v: into the body of i
        chance = np.array([each.random(mavs) for each in self._generators])
        noise = np.array([each.standard_normal((mavs, 3)) for each in self._generators])
        detected = (chance < self._detector.P_D) & self._detector.in_view(seen_from) & ~np.eye(mavs, dtype=bool)
        measured = self._measure(seen_from, noise)
        false = [each.random((each.poisson(self._detector.false_per_set), 3)) for each in self._generators]
        sets = []
        for i, draw in enumerate(self._generators):
            found = detected[i]
            spherical = np.concatenate([measured[i, found], self._in_volume(false[i])])
            labels = np.concatenate([self._ids[found], np.zeros(len(false[i]), np.uint8)])
            order = draw.permutation(len(labels))
            sets.append(DetectionSet(spherical[order], labels[order]))
        return sets

    def _measure(self, true: Array, noise: Array) -> Array:
        """(..., 3) noisy [range, azimuth, elevation]; the direction swings by the same sigma along both axes across
        the line of sight, so that nothing is special about the poles."""
        azimuth, elevation = true[..., 1], true[..., 2]
        sight = direction(azimuth, elevation)
        to_the_left = direction(azimuth + np.pi / 2, np.zeros_like(azimuth))
        upward = direction(azimuth, elevation + np.pi / 2)
        swing = self._detector.bearing_sigma_rad * noise[..., :2]
        angle = np.hypot(swing[..., 0], swing[..., 1])[..., None]
        across = swing[..., :1] * to_the_left + swing[..., 1:] * upward
        bearing = range_and_bearing(np.cos(angle) * sight + np.sinc(angle / np.pi) * across)
        ranges = true[..., 0] + self._detector.range_sigma_m(true[..., 0]) * noise[..., 2]
        return np.stack([np.maximum(ranges, LEAST_RANGE_M), bearing[..., 1], bearing[..., 2]], axis=-1)

    def _in_volume(self, unit: Array) -> Array:
        """(F, 3) [range, azimuth, elevation] from numbers between 0 and 1: equally many in equal volumes in view."""
        if not len(unit):
            return unit
        highest = np.sin(self._detector.fov_elevation_rad / 2)
        spherical = np.empty_like(unit)
        spherical[:, 0] = np.maximum(self._detector.max_range_m * np.cbrt(unit[:, 0]), LEAST_RANGE_M)
        spherical[:, 1] = self._detector.fov_azimuth_rad * (unit[:, 1] - 0.5)
        spherical[:, 2] = np.arcsin(highest * (2 * unit[:, 2] - 1))
        return spherical
