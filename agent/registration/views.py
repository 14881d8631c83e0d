"""What should every station see of every target, and how well does a detection agree? In range, azimuth, elevation.

Residuals are nu = [r - r_hat, cos(el_hat) wrap(az - az_hat), el - el_hat] in m, rad, rad, with the sensor's noise at
the *predicted* range. A false detection is uniform over the volume in view, so in these coordinates its density at
range r is lambda r^2.
"""

from typing import NamedTuple

import numpy as np

from agent.interface.frames import Array, range_and_bearing, wrap
from agent.interface.sensors import Detector

AGREES = 60.0  # squared normalised residual above which a detection says nothing of a target
NEAREST_M = 0.3  # of two MAVs' centres: for the density of false detections, and against a division by zero


def predicted(stations: Array, targets: Array) -> Array:
    """(..., 3) [range m, azimuth rad in common axes, elevation rad] from stations' to targets' positions (..., 3)."""
    return range_and_bearing(targets - stations)


def axes(spherical: Array) -> Array:
    """(..., 3, 3) derivative of nu with respect to the target's position: rows range, azimuth cos(el), elevation."""
    distance = np.maximum(spherical[..., 0], NEAREST_M)
    ca, sa = np.cos(spherical[..., 1]), np.sin(spherical[..., 1])
    ce, se = np.cos(spherical[..., 2]), np.sin(spherical[..., 2])
    G = np.zeros((*distance.shape, 3, 3))
    G[..., 0, 0], G[..., 0, 1], G[..., 0, 2] = ce * ca, ce * sa, se
    G[..., 1, 0], G[..., 1, 1] = -sa / distance, ca / distance
    G[..., 2, 0], G[..., 2, 1], G[..., 2, 2] = -se * ca / distance, -se * sa / distance, ce / distance
    return G


class Residuals(NamedTuple):
    """nu of detections against predictions, by component: sums over an axis of three would cost more than they do."""

    distance: Array  # (..., M) m
    azimuth: Array  # (..., M) rad, times cos(el)
    elevation: Array  # (..., M) rad

    def square(self, variances: Array) -> Array:
        """(..., M) normalised by variances (..., 3)."""
        by = 1.0 / variances[..., None, :]
        return np.asarray(self.distance**2 * by[..., 0] + self.azimuth**2 * by[..., 1] + self.elevation**2 * by[..., 2])


def residuals(spherical: Array, yaw: Array, detections: Array) -> Residuals:
    """Of detections (..., M, 3) against predictions (..., 3) by stations with these yaws (...)."""
    turned = detections[..., 1] + (yaw - spherical[..., 1])[..., None]
    turned -= 2 * np.pi * np.rint(turned / (2 * np.pi))
    turned *= np.cos(spherical[..., 2])[..., None]
    return Residuals(detections[..., 0] - spherical[..., None, 0], turned, detections[..., 2] - spherical[..., None, 2])


def noise(detector: Detector, distance: Array) -> Array:
    """Variances (..., 3) of nu at predicted distances (...), m."""
    R = np.empty((*distance.shape, 3))
    R[..., 0] = detector.range_sigma_m(distance) ** 2
    R[..., 1:] = detector.bearing_sigma_rad**2
    return R


def clutter(detector: Detector, measured_range: Array) -> Array:
    """Density of false detections in the coordinates of nu, 1 / (m rad^2)."""
    density: Array = detector.clutter_density * np.maximum(measured_range, NEAREST_M) ** 2
    return density


def detection_probability(detector: Detector, spherical: Array, yaw: Array) -> Array:
    """P_D (...) of targets predicted at (..., 3) by stations with these yaws (...); 0 out of view."""
    if detector.sees_all_around:
        return np.where(spherical[..., 0] <= detector.max_range_m, detector.P_D, 0.0)
    body = spherical.copy()
    body[..., 1] = wrap(spherical[..., 1] - yaw)
    return np.where(detector.in_view(body), detector.P_D, 0.0)


def log_seen(detector: Detector, spherical: Array, yaw: Array, variances: Array, detections: Array) -> Array:
    """log(1 - P_D + P_D sum_m N(nu_m; 0, S) / kappa) of one target each (...): how well a set agrees with it.

    Args:
        detector: the sensor's model.
        spherical: (..., 3) prediction, common axes.
        yaw: (...) rad of the station.
        variances: (..., 3) of nu: sensor noise and uncertainty of the prediction.
        detections: (..., M, 3), NaN where there is none.
    """
    square = residuals(spherical, yaw, detections).square(variances)
    scale = np.sqrt((2 * np.pi) ** 3 * variances.prod(-1))[..., None] * clutter(detector, detections[..., 0])
    # NaN compares false: no detection there
    agreement = np.where(square < AGREES, np.exp(-0.5 * square) / scale, 0.0).sum(-1)
    P_D = detection_probability(detector, spherical, yaw)
    return np.asarray(np.log(1 - P_D + P_D * agreement))
