"""What does an odometry reading tell? (the paper, Sec. IV-B.1)

    z_i = [ p_odom_body ; psi_common_body - psi_common_odom ]

is linear in the state, so this update is the exact Kalman one; the yaw residual is wrapped.
"""

import numpy as np
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
    bodies = state.bodies
    entries = 8 * np.arange(bodies)[:, None] + np.arange(4)
    present = np.isfinite(odometry[:, 3])
    rows, z = (entries, odometry) if present.all() else (entries[present], odometry[present])
    if not len(rows):
        return state
    flat = rows.ravel()
    frames = rows[:, 3] + 4  # the yaws that the body's yaw is measured against
    residual = z - state.x[rows]
    residual[:, 3] = wrap(residual[:, 3] + state.x[frames])
    PHt = state.P[:, flat]
    PHt[:, 3::4] -= state.P[:, frames]
    S = PHt[flat]
    S[3::4] -= PHt[frames]
    S.ravel()[:: len(flat) + 1] += np.tile(np.repeat(np.square(sigma), (3, 1)), len(rows))
    factor, info = lapack.dpotrf(S, lower=1, clean=1)
    assert info == 0, "the innovation covariance of odometry is not positive definite"
    whitened, _ = lapack.dtrtrs(factor, np.column_stack([PHt.T, residual.ravel()]), lower=1)
    A, nu = whitened[:, :-1], whitened[:, -1]
    return State(state.x + nu @ A, state.P - A.T @ A, state.station)
