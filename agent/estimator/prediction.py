"""How does the belief move with time? (the paper, Sec. IV-A and V-A step 1)

The model is linear in its input, so the Kalman equations are exact and no sigma points are needed. Input is the
increment of each MAV's odometry; the drift of VIO is process noise on the odometry frames.

Deviation from the paper: its diagonal Q is not enough. VIO noise per update, n on the body's increment and w on its
yaw, moves frame i by

    psi_common_odom += w,   psi_common_body += w,   p_common_odom += n - w J Rz(psi_common_odom) p_odom_body

with J = d/dpsi Rz at 0: the frame turns about the body, not about itself. And since the common frame is the drifting
odometry frame of the estimating MAV s, the drift of s moves every other MAV, fully correlated (rank 4):

    p_common_odom += n_s + w_s J (p_s - p_common_odom),   psi_common_odom -= w_s,   psi_common_body -= w_s

That is for an increment that was read, which the motion and the drift make together. Where it is a guess of the motion,
drift does not move the body but its unheard reading: p_odom_body -= Rz(psi_common_odom)^T n, and the yaw read -= w.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.estimator.state import P_FRAME, P_ODOM, PSI, PSI_FRAME, State
from agent.interface.frames import Array, rotate_z

Mask = npt.NDArray[np.bool_]


class _Drift(NamedTuple):
    """What of Gamma is the same at every tick, and where (in the flattened array) the rest goes."""

    constant: Array  # (8B, 4B)
    own_yaw: npt.NDArray[np.intp]  # (2, D) x and y rows of the D drifting frames, column of their own yaw noise
    station_yaw: npt.NDArray[np.intp]  # (2, B - 1) x and y rows of all but the station, column of its yaw noise
    drifting: npt.NDArray[np.intp]  # (D,) the MAVs but the station
    moved: npt.NDArray[np.intp]  # (B - 1,) all bodies but the station


@lru_cache(maxsize=64)
def _drift(bodies: int, own: int) -> _Drift:
    moved = np.array([i for i in range(bodies) if i != own])
    drifting = moved[:-1]
    Gamma = np.zeros((bodies, 8, bodies, 4))
    for i in drifting:
        Gamma[i, (4, 5, 6), i, (0, 1, 2)] = 1.0
        Gamma[i, (PSI, PSI_FRAME), i, 3] = 1.0
    for i in moved:
        Gamma[i, (4, 5, 6), own, (0, 1, 2)] = 1.0
        Gamma[i, (PSI, PSI_FRAME), own, 3] = -1.0
    entries = np.arange(Gamma.size).reshape(Gamma.shape)
    own_yaw = np.array([entries[drifting, row, drifting, 3] for row in (4, 5)])
    station_yaw = np.array([entries[moved, row, own, 3] for row in (4, 5)])
    return _Drift(Gamma.reshape(8 * bodies, 4 * bodies), own_yaw, station_yaw, drifting, moved)


def drift_input(state: State) -> Array:
    """Gamma (8B, 4B): how the VIO noise [n (3), w] of every body enters the state; the start has none of its own."""
    own, s = state.station - 1, state.by_body
    drift = _drift(state.bodies, own)
    Gamma = drift.constant.copy()
    flat = Gamma.ravel()
    turned = rotate_z(s[drift.drifting, PSI_FRAME], s[drift.drifting, P_ODOM])
    flat[drift.own_yaw] = turned[:, 1], -turned[:, 0]
    arm = s[own, P_ODOM] - s[drift.moved, P_FRAME]
    flat[drift.station_yaw] = -arm[:, 1], arm[:, 0]
    return Gamma


def predict(
    state: State, increments: Array, input_sigma: Array, drift_sigma: tuple[float, float], coasting: Mask | None = None
) -> State:
    """The state one tick later.

    Args:
        state: at the last tick.
        increments: (B, 4) of every odometry pose since then, in its odometry frame: m, and rad of yaw.
        input_sigma: (B, 2) standard deviation of an increment, per axis m and rad: white noise of the readings, or
            what a MAV whose odometry is missing may have done meanwhile.
        drift_sigma: standard deviation of VIO drift per tick, per axis m and rad.
        coasting: (B,) whose increment was not read, but is a guess of its motion; nobody's, if left out.
    """
    bodies = state.bodies
    x = state.x.copy()
    by_body = x.reshape(bodies, 8)
    by_body[:, :4] += increments
    position_sigma, yaw_sigma = drift_sigma
    Gamma = drift_input(state)
    if coasting is not None and coasting.any():
        i, by_noise = coasting.nonzero()[0], Gamma.reshape(bodies, 8, bodies, 4)
        yaw = state.by_body[i, PSI_FRAME]
        by_noise[i, 0, i, 0] = by_noise[i, 1, i, 1] = -np.cos(yaw)
        by_noise[i, 1, i, 0] = np.sin(yaw)
        by_noise[i, 0, i, 1] = -by_noise[i, 1, i, 0]
        by_noise[i, 2, i, 2] = -1.0
        by_noise[i, PSI, i, 3] -= 1.0
    Gamma *= np.array([position_sigma, position_sigma, position_sigma, yaw_sigma] * bodies)
    P = Gamma @ Gamma.T
    P += state.P
    diagonal = P.ravel()[:: 8 * bodies + 1].reshape(bodies, 8)
    variance = input_sigma * input_sigma
    diagonal[:, P_ODOM] += variance[:, :1]
    diagonal[:, PSI] += variance[:, 1]
    return State(x, P, state.station)
