"""What should every station see of every target, and how well does a detection agree? In range, azimuth, elevation.

Residuals are nu = [r - r_hat, cos(el_hat) wrap(az - az_hat), el - el_hat] in m, rad, rad, with the sensor's noise at
the *predicted* range. A false detection is uniform over the volume in view, so in these coordinates its density at
range r is lambda r^2.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array, range_and_bearing, wrap
from agent.interface.sensors import Detector

NOWHERE_M, TURN = 1e4, 2 * np.pi  # the range of a detection that is not there: it agrees with nothing
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

    In single precision: it is a thousandth of a nat, and half the time.

    Args:
        detector: the sensor's model.
        spherical: (..., 3) prediction, common axes.
        yaw: (...) rad of the station.
        variances: (..., 3) of nu: sensor noise and uncertainty of the prediction.
        detections: (..., M, 3), NaN where there is none.
    """
    z = np.where(np.isnan(detections), NOWHERE_M, detections)
    precision = 1.0 / variances
    precision[..., 1] *= np.cos(spherical[..., 2]) ** 2
    seen = spherical.copy()
    seen[..., 1] -= yaw
    seen[..., 1] %= TURN
    part, azimuth = seen.astype(np.float32)[..., None], (z[..., 1] % TURN).astype(np.float32)
    square = _square(z[..., 0].astype(np.float32) - part[..., 0, :], precision[..., 0])
    around = np.abs(azimuth - part[..., 1, :])
    square += _square(np.minimum(around, np.float32(TURN) - around), precision[..., 1])
    square += _square(z[..., 2].astype(np.float32) - part[..., 2, :], precision[..., 2])
    square *= np.float32(-0.5)
    agreement = np.exp(square, out=square)
    agreement *= (1.0 / clutter(detector, z[..., 0])).astype(np.float32)
    scale = np.sqrt((2 * np.pi) ** 3 * variances.prod(-1))
    P_D = detection_probability(detector, spherical, yaw)
    return np.asarray(np.log(1 - P_D + P_D * (agreement.sum(-1) / scale)))


def _square(difference: npt.NDArray[np.float32], precision: Array) -> npt.NDArray[np.float32]:
    """Of differences (..., M), times precisions (...); in their place."""
    difference *= difference
    difference *= precision.astype(np.float32)[..., None]
    return difference
