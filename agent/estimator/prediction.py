"""How does the belief move with time? (the paper, Sec. IV-A and V-A step 1)

The model is linear in its input, so the Kalman equations are exact and no sigma points are needed. Input is the
increment of each MAV's odometry; the drift of VIO is process noise on the odometry frames.

Deviation from the paper: its diagonal Q is not enough. VIO noise per update, n on the body's increment and w on its
yaw, moves frame i by

    psi_common_odom += w,   psi_common_body += w,   p_common_odom += n - w J Rz(psi_common_odom) p_odom_body

with J = d/dpsi Rz at 0: the frame turns about the body, not about itself. And since the common frame is the drifting
odometry frame of the estimating MAV s, the drift of s moves every other MAV, fully correlated (rank 4):

    p_common_odom += n_s + w_s J (p_s - p_common_odom),   psi_common_odom -= w_s,   psi_common_body -= w_s
"""

import numpy as np

from agent.estimator.state import P_FRAME, P_ODOM, PSI, PSI_FRAME, State
from agent.interface.frames import Array, rotate_z


def drift_input(state: State) -> Array:
    """Gamma (8B, 4B): how the VIO noise [n (3), w] of every body enters the state; the start has none of its own."""
    bodies, own, s = state.bodies, state.station - 1, state.by_body
    Gamma = np.zeros((bodies, 8, bodies, 4))
    every = np.arange(bodies)
    turned = rotate_z(s[:, PSI_FRAME], s[:, P_ODOM])
    Gamma[every[:, None], (4, 5, 6), every[:, None], (0, 1, 2)] = 1.0
    Gamma[every, PSI, every, 3] = 1.0
    Gamma[every, PSI_FRAME, every, 3] = 1.0
    Gamma[every, 4, every, 3] = turned[:, 1]
    Gamma[every, 5, every, 3] = -turned[:, 0]
    arm = s[own, P_ODOM] - s[:, P_FRAME]
    Gamma[:, :, own, :] = 0.0
    Gamma[:, (4, 5, 6), own, (0, 1, 2)] = 1.0
    Gamma[:, PSI, own, 3] = -1.0
    Gamma[:, PSI_FRAME, own, 3] = -1.0
    Gamma[:, 4, own, 3] = -arm[:, 1]
    Gamma[:, 5, own, 3] = arm[:, 0]
    Gamma[own] = 0.0  # the gauge
    Gamma[:, :, -1] = 0.0
    return Gamma.reshape(8 * bodies, 4 * bodies)


def predict(
    state: State, increments: Array, input_sigma: Array, drift_sigma: tuple[float, float], updates: float = 1.0
) -> State:
    """The state one tick later.

    Args:
        state: at the last tick.
        increments: (B, 4) of every odometry pose since then, in its odometry frame: m, and rad of yaw.
        input_sigma: (B, 2) standard deviation of an increment, per axis m and rad: white noise of the readings, or
            what a MAV whose odometry is missing may have done meanwhile.
        drift_sigma: standard deviation of VIO drift per update, per axis m and rad.
        updates: how many VIO updates the tick holds.
    """
    bodies = state.bodies
    x, P = state.x.copy(), state.P.copy()
    by_mav = x.reshape(bodies, 8)
    by_mav[:, P_ODOM] += increments[:, :3]
    by_mav[:, PSI] += increments[:, 3]
    Gamma = drift_input(state) * np.tile(np.repeat(drift_sigma, (3, 1)), bodies)
    P += updates * (Gamma @ Gamma.T)
    diagonal = np.zeros((bodies, 8))
    diagonal[:, P_ODOM] = input_sigma[:, :1] ** 2
    diagonal[:, PSI] = input_sigma[:, 1] ** 2
    P.ravel()[:: 8 * bodies + 1] += diagonal.ravel()
    return State(x, P, state.station)
