"""How good are the sensors? The noise models that a driver states and an estimator believes."""

import math

import msgspec
import numpy as np

from agent.interface.frames import Array


class Detector(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Anonymous range-and-bearing detection of MAVs (the paper, Sec. VI-A.2; field of view and range are ours)."""

    P_D: float = 0.9  # probability that a MAV in view is detected
    false_per_set: float = 0.5  # mean number of false detections in one set, uniform over the volume in view
    bearing_sigma_rad: float = 0.008  # on either axis across the line of sight (the paper)
    range_sigma_slope: float = 0.0495  # m of range noise per m of range (the paper)
    range_sigma_offset_m: float = 0.0336  # (the paper)
    max_range_m: float = 12.0
    fov_azimuth_rad: float = 2 * math.pi  # full width about the body's x axis; the paper's cameras look all around
    fov_elevation_rad: float = math.pi  # full width about the horizontal

    def __post_init__(self) -> None:
        # The floors are far below any sensor there is; much finer, and the filter's covariances lose their last digits.
        _require("P_D", self.P_D, 0 < self.P_D < 1, "a probability between 0 and 1, both excluded")
        for name, value, least, most, unit in (
            ("false_per_set", self.false_per_set, 1e-6, 100, ""),
            ("bearing_sigma_rad", self.bearing_sigma_rad, 1e-4, 1, " rad"),
            ("range_sigma_slope", self.range_sigma_slope, 0, 1, ""),
            ("range_sigma_offset_m", self.range_sigma_offset_m, 1e-4, 10, " m"),
            ("max_range_m", self.max_range_m, 0.1, 1000, " m"),
            ("fov_azimuth_rad", self.fov_azimuth_rad, 0.01, 2 * math.pi, " rad"),
            ("fov_elevation_rad", self.fov_elevation_rad, 0.01, math.pi, " rad"),
        ):
            _require(name, value, least <= value <= most, f"{least:g} to {most:g}{unit}")

    def range_sigma_m(self, distance_m: Array) -> Array:
        """Standard deviation of the measured range at true distances (...), m."""
        return self.range_sigma_slope * distance_m + self.range_sigma_offset_m

    @property
    def clutter_density(self) -> float:
        """False detections per m^3 of the volume in view (lambda in the paper)."""
        solid_angle = self.fov_azimuth_rad * 2 * math.sin(self.fov_elevation_rad / 2)
        return self.false_per_set / (solid_angle * self.max_range_m**3 / 3)

    @property
    def sees_all_around(self) -> bool:
        return self.fov_azimuth_rad >= 2 * math.pi and self.fov_elevation_rad >= math.pi

    def in_view(self, spherical: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Which of the true places (..., 3) [range m, azimuth rad, elevation rad] the detector can see at all."""
        return np.asarray(
            (spherical[..., 0] <= self.max_range_m)
            & (np.abs(spherical[..., 1]) <= self.fov_azimuth_rad / 2)
            & (np.abs(spherical[..., 2]) <= self.fov_elevation_rad / 2)
        )


class Odometry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Visual-inertial odometry whose pose drifts as a random walk (the paper, Sec. VI-A.1, integrated)."""

    position_sigma_m: float = 0.01  # per axis and update
    yaw_sigma_rad: float = 0.002  # per update

    def __post_init__(self) -> None:
        _require("position_sigma_m", self.position_sigma_m, 0 <= self.position_sigma_m < 1, "between 0 and 1 m")
        _require("yaw_sigma_rad", self.yaw_sigma_rad, 0 <= self.yaw_sigma_rad < 1, "between 0 and 1 rad")


def _require(name: str, value: float, holds: bool, expected: str) -> None:
    if not holds:
        raise ValueError(f"{name} = {value!r}: expected {expected}")
