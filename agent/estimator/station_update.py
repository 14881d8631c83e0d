"""What does one detection set of one station change? The paper iterates this over its stations (Sec. V).

Station updates of a tick follow one another on the same poses; the sensor noise and the detection probabilities of
all pairs are taken once a tick, at its predicted poses.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.estimator import cpdaf, detection_model
from agent.estimator.moments import DetectionGeometry, detection_moments
from agent.estimator.small_matrices import diagonal_index
from agent.estimator.state import Poses
from agent.interface.frames import Array, rotate_z
from agent.interface.sensors import Detector


class Pairs(NamedTuple):
    """What the detector makes of every pair of bodies at the poses of a tick, [station, target]."""

    lines: Array  # (B, B, 3) m, common axes
    R: Array  # (B, B, 3, 3) m^2, common axes
    P_D: Array  # (B, B), 0 for what is no pair of different MAVs

    @staticmethod
    def at(poses: Poses, detector: Detector) -> "Pairs":
        by_body = poses.by_body
        lines = by_body[None, :, :3] - by_body[:, None, :3]
        P_D = detection_model.detection_probability(detector, lines, by_body[:, None, 3])
        np.fill_diagonal(P_D, 0.0)
        P_D[-1] = P_D[:, -1] = 0.0  # the start is not a MAV
        return Pairs(lines, detection_model.noise_covariance(detector, lines), P_D)


class Updated(NamedTuple):
    poses: Poses
    found: cpdaf.Association


def station_update(
    poses: Poses,
    geometry: DetectionGeometry,
    pairs: Pairs,
    spherical: Array,
    clutter_density: float,
    rules: cpdaf.Rules,
    labels: npt.NDArray[np.intp] | None = None,
) -> Updated:
    """The poses given one anonymous detection set.

    Args:
        poses: before it.
        geometry: of the station whose set it is.
        pairs: of this tick.
        spherical: (M, 3) range m, azimuth rad, elevation rad in the station's gravity-aligned body frame; M > 0.
        clutter_density: 1/m^3.
        rules: gates and pruning.
        labels: (M,) for a filter that is told the truth: the MAV (1..N) that each detection is of, 0 if it is false.
    """
    targets, own, L = geometry.targets, geometry.own, len(geometry.targets)
    moments = detection_moments(poses, geometry)
    S = moments.P_zz
    S.ravel()[diagonal_index(L)] += pairs.R[own, targets].reshape(L, 9)
    z = rotate_z(poses.y[geometry.yaw_row], detection_model.cartesian(spherical))
    innovations = z - moments.z_hat[:, None]
    if labels is None:
        found = cpdaf.associate(S, innovations, pairs.P_D[own, targets], clutter_density, rules)
    else:
        found = cpdaf.told(S, innovations, np.where(labels > 0, np.searchsorted(targets, labels - 1), -1))
    if not len(found.rows):
        return Updated(poses, found)
    P_yz = moments.P_yz[:, found.rows]
    return Updated(Poses(poses.y + P_yz @ found.g, poses.Sigma - P_yz @ found.W @ P_yz.T), found)
