"""What does an odometry reading tell? (the paper, Sec. IV-B.1)

    z_i = [ p_odom_body ; psi_common_body - psi_common_odom ]

is linear in the state, so this update is the exact Kalman one; the yaw residual is wrapped.
"""

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from agent.estimator.state import State
from agent.interface.frames import Array, wrap


def update(state: State, odometry: Array, sigma: tuple[float, float]) -> State:
    """The state given the readings of this tick.

    Args:
        state: predicted to this tick.
        odometry: (B, 4) x y z m, yaw rad of every body in its odometry frame; a row of NaN where there is none.
        sigma: standard deviation of a reading, per axis m and rad.
    """
    bodies, present = state.bodies, np.isfinite(odometry[:, 3])
    if present.all():
        rows = _rows(bodies)
    else:
        rows, odometry = _rows(bodies)[present], odometry[present]
    flat, psi, psi_frame = rows.ravel(), rows[:, 3], rows[:, 3] + 4
    residual = odometry - state.x[rows]
    residual[:, 3] = wrap(residual[:, 3] + state.x[psi_frame])
    HP = state.P[flat]  # (4 per reading, 8B)
    HP[3::4] -= state.P[psi_frame]
    S = HP.take(flat, axis=1)
    S[:, 3::4] -= HP[:, psi_frame]
    position, yaw = sigma[0] ** 2, sigma[1] ** 2
    diagonal = S.ravel()[:: len(flat) + 1]
    diagonal += np.array([position, position, position, yaw] * len(psi))
    factor, info = lapack.dpotrf(S, lower=1, clean=1)
    assert info == 0, "the innovation covariance of odometry is not positive definite"
    A, _ = lapack.dtrtrs(factor, HP, lower=1)
    nu, _ = lapack.dtrtrs(factor, residual.ravel(), lower=1)
    return State(state.x + nu @ A, state.P - A.T @ A, state.station)


@lru_cache(maxsize=64)
def _rows(bodies: int) -> npt.NDArray[np.intp]:
    """(B, 4) entries of the state that readings measure, the frame's yaw apart."""
    return 8 * np.arange(bodies)[:, None] + np.arange(4)
