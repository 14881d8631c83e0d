"""Which MAVs does each MAV see, and how exactly? Anonymous range-and-bearing detections with false ones among them."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.fleet import Fleet
from agent.interface.frames import Array, range_and_bearing, wrap
from agent.interface.seeds import generator
from agent.interface.sensors import Detector
from world.poses import Poses, rotations

LEAST_RANGE_M = 0.01  # a measured range is positive, whatever its noise


class DetectionSet(NamedTuple):
    """What one MAV's detector reports, and (not for agents) what it really was."""

    spherical: Array  # (M, 3) range m, azimuth rad, elevation rad, in the rolled and pitched body frame
    labels: npt.NDArray[np.uint8]  # (M,) MAV 1..N, or 0 for a false detection


class Detectors:
    """The detectors of all MAVs; each has its own stream of random numbers."""

    def __init__(self, detector: Detector, fleet: Fleet) -> None:
        self._detector, self._mavs = detector, fleet.mavs
        self._ids = np.arange(1, fleet.mavs + 1, dtype=np.uint8)
        self._others = ~np.eye(fleet.mavs, dtype=bool)
        self._generators = [generator(fleet.seed, f"detector/{mav}") for mav in fleet.ids]

    def detect(self, true: Poses) -> list[DetectionSet]:
        """One set per MAV, in random order, from the true poses in the world."""
        draws = self._draw()
        apart = true.position[None] - true.position[:, None]  # (N, N, 3): [i, j] from i to j
        seen_from = range_and_bearing(apart @ rotations(true.quaternion))  # v @ R = R^T v: into the body of i
        detected = (draws.chance < self._detector.P_D) & self._detector.in_view(seen_from) & self._others
        by, target = np.nonzero(detected)
        falsely_by = np.repeat(np.arange(self._mavs), [len(each) for each in draws.false])
        false = np.concatenate(draws.false)
        # All sets in one table: first in any order, then by MAV and, within a MAV's set, by chance.
        measured = self._measure(seen_from[by, target], draws.noise[by, target])
        spherical = np.concatenate([measured, self._in_volume(false[:, 1:])])
        labels = np.concatenate([self._ids[target], np.zeros(len(false), np.uint8)])
        whose = np.concatenate([by, falsely_by])
        order = np.argsort(whose + np.concatenate([draws.place[by, target], false[:, 0]]))
        spherical, labels = spherical[order], labels[order]
        ends = np.cumsum(np.bincount(whose, minlength=self._mavs)).tolist()
        return [
            DetectionSet(spherical[begin:end], labels[begin:end])
            for begin, end in zip([0, *ends[:-1]], ends, strict=True)
        ]

    def _draw(self) -> "_Draws":
        """Each generator's numbers depend on nothing but itself: not on what is seen."""
        uniform, noise, false = np.empty((self._mavs, 2, self._mavs)), np.empty((self._mavs, self._mavs, 3)), []
        for i, each in enumerate(self._generators):
            each.random(out=uniform[i])
            each.standard_normal(out=noise[i])
            false.append(each.random((each.poisson(self._detector.false_per_set), 4)))
        return _Draws(uniform[:, 0], uniform[:, 1], noise, false)

    def _measure(self, true: Array, noise: Array) -> Array:
        """(D, 3) noisy [range, azimuth, elevation]; the direction swings by the same sigma along both axes across
        the line of sight, so that nothing is special about the poles."""
        ranges, azimuth, elevation = true.T
        left, up = self._detector.bearing_sigma_rad * noise[:, :2].T
        angle = np.hypot(left, up)
        across, along = np.sin(angle) / np.maximum(angle, 1e-300), np.cos(angle)
        sine, cosine = np.sin(elevation), np.cos(elevation)
        # The measured direction along the azimuth's axis, level and to the left of it, and upright.
        ahead = along * cosine - across * up * sine
        left = across * left
        upward = along * sine + across * up * cosine
        measured = np.empty_like(true)
        measured[:, 0] = np.maximum(ranges + self._detector.range_sigma_m(ranges) * noise[:, 2], LEAST_RANGE_M)
        measured[:, 1] = wrap(azimuth + np.arctan2(left, ahead))
        measured[:, 2] = np.arctan2(upward, np.hypot(ahead, left))
        return measured

    def _in_volume(self, unit: Array) -> Array:
        """(F, 3) [range, azimuth, elevation] from numbers between 0 and 1: equally many in equal volumes in view."""
        highest = np.sin(self._detector.fov_elevation_rad / 2)
        spherical = np.empty_like(unit)
        spherical[:, 0] = np.maximum(self._detector.max_range_m * np.cbrt(unit[:, 0]), LEAST_RANGE_M)
        spherical[:, 1] = self._detector.fov_azimuth_rad * (unit[:, 1] - 0.5)
        spherical[:, 2] = np.arcsin(highest * (2 * unit[:, 2] - 1))
        return spherical


class _Draws(NamedTuple):
    """The random numbers of one tick; uniform ones lie between 0 and 1."""

    chance: Array  # (N, N) uniform: [i, j] whether i detects j
    place: Array  # (N, N) uniform: where in the set
    noise: Array  # (N, N, 3) of unit variance
    false: list[Array]  # N times (F, 4) uniform: where in the set, then where in the volume
