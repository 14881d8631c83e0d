"""How far is every detection of a tick from where every MAV should be seen, at the tick's prior?

The measurement is linearised: a target's place as its station sees it, turned into common axes by the station's yaw.
"""

from typing import NamedTuple

import numpy as np

from agent.estimator.detection_model import cartesian
from agent.estimator.small_matrices import inverses
from agent.estimator.state import Poses
from agent.estimator.station_update import Pairs
from agent.interface.frames import Array, rotate_z


class Innovations(NamedTuple):
    """Of B bodies and sets of up to M detections, [station, target, detection]; NaN where a set has no more."""

    nu: Array  # (B, B, M, 3) m, common axes
    distance: Array  # (B, B, M) squared Mahalanobis distances
    determinant: Array  # (B, B) of S, m^6

    @staticmethod
    def of(poses: Poses, pairs: Pairs, stations: list[int], sets: list[Array]) -> "Innovations | None":
        """None if all sets are empty.

        Args:
            poses: predicted to this tick.
            pairs: of this tick.
            stations: K, the body whose set each is.
            sets: K times (M, 3) range m, azimuth rad, elevation rad.
        """
        counts = [len(spherical) for spherical in sets]
        if not any(counts):
            return None
        station = np.repeat(stations, counts)
        within = np.concatenate([np.arange(n) for n in counts])
        bodies = len(pairs.P_D)
        z = np.full((bodies, max(counts), 3), np.nan)
        z[station, within] = rotate_z(poses.by_body[station, 3], cartesian(np.concatenate(sets)))
        nu = z[:, None] - pairs.lines[:, :, None]
        S = inverses(_covariances(poses, pairs))
        distance = ((nu @ S.inverse.reshape(bodies, bodies, 3, 3)) * nu).sum(3)
        return Innovations(nu, distance, S.determinant.reshape(bodies, bodies))


def yaw_column(lines: Array) -> Array:
    """d h / d psi_s in levelled axes."""
    J = np.zeros_like(lines)
    J[..., 0], J[..., 1] = lines[..., 1], -lines[..., 0]
    return J


def _covariances(poses: Poses, pairs: Pairs) -> Array:
    """(B * B, 3, 3) S of every pair on its own, sensor noise included."""
    bodies = len(pairs.P_D)
    T = poses.Sigma.reshape(bodies, 4, bodies, 4)
    every = np.arange(bodies)
    W = T[:, :3, :, :3].transpose(0, 2, 1, 3)  # cov(p_a, p_b)
    own = W[every, every]
    with_yaw = T[:, :3, :, 3]  # cov(p_a, psi_s) as [a, :, s]
    J = yaw_column(pairs.lines)
    half = (
        with_yaw.transpose(2, 0, 1)
        - with_yaw[every, :, every][:, None]
        + 0.5 * T[every, 3, every, 3][:, None, None] * J
    )
    S = own[:, None] + own - W - W.transpose(1, 0, 2, 3) + pairs.R
    turn = J[..., :, None] * half[..., None, :]
    S += turn
    S += turn.swapaxes(2, 3)
    return S.reshape(-1, 3, 3)
