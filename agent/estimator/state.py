"""What is estimated, and where in the arrays is it?

Per MAV i, 8 numbers in the common frame, which is the odometry frame f_s of the MAV s that estimates:

    x_i = [ p_odom_body (3) | psi_common_body | p_common_odom (3) | psi_common_odom ]

(the paper, Sec. IV-A; its "7N" is a slip: 3 + 1 + 3 + 1). The gauge is pinned: the frame entries of s itself are
zero, with zero variance, so yaws are relative to s and stay certain enough to linearise, however long the flight.

Since f_s drifts, "where s began" moves in it. That place is kept as one more row, the *start*: a body that never moves
and is never seen. It is correlated with everybody else through the drift of s, so what the detections tell of that
drift corrects it too, and absolute poses profit from everybody's odometry, not from that of s alone.

Detections depend on the 4 numbers of every MAV's pose in the common frame only,

    y_i = [ p_common_body (3) | psi_common_body ],     p_common_body = Rz(psi_common_odom) p_odom_body + p_common_odom

so all station updates of a tick are done on (y, Sigma), and lifted to (x, P) once: for a Gaussian that is exact, up
to the linearisation of y(x), which is then made once a tick (and by exact moments while yaws are uncertain).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array

P_ODOM, PSI, P_FRAME, PSI_FRAME = slice(0, 3), 3, slice(4, 7), 7  # of the 8 entries of one MAV


@dataclass
class State:
    """Mean x (8B,) and covariance P (8B, 8B), m and rad, of the B bodies: MAVs 1..N (index 0..N-1) and the start of
    MAV `station`, in whose odometry frame they are seen."""

    x: Array
    P: Array
    station: int

    @property
    def bodies(self) -> int:
        return len(self.x) // 8

    @property
    def by_body(self) -> Array:
        """A view of x, (B, 8)."""
        return self.x.reshape(-1, 8)


@dataclass
class Poses:
    """Mean y (4B,) and covariance Sigma (4B, 4B) of all current poses in the common frame."""

    y: Array
    Sigma: Array

    @property
    def by_body(self) -> Array:
        """A view of y, (B, 4)."""
        return self.y.reshape(-1, 4)


def from_frames(
    frames: Array, odometry: Array, station: int, sigma_frames: tuple[float, float], sigma_odometry: tuple[float, float]
) -> State:
    """The state that a prior on the odometry frames makes.

    Args:
        frames: (B, 4) x y z m, yaw rad of every body's odometry frame in the common frame; zero for the start.
        odometry: (B, 4) the odometry readings for which the state is wanted; zero for the start.
        station: 1..N.
        sigma_frames: standard deviation of a frame's position (per axis, m) and yaw (rad).
        sigma_odometry: the same of an odometry reading.
    """
    bodies, own = len(frames), station - 1
    known = (own, bodies - 1)  # frames of the station and of its start
    x = np.zeros((bodies, 8))
    x[:, P_ODOM] = odometry[:, :3]
    x[:, P_FRAME] = frames[:, :3]
    x[:, PSI_FRAME] = frames[:, 3]
    x[:, PSI] = frames[:, 3] + odometry[:, 3]
    P = np.zeros((bodies, 8, bodies, 8))
    for i in range(bodies):
        P[i, :, i, :] = np.diag([sigma_odometry[0] ** 2] * 3 + [0.0] + [sigma_frames[0] ** 2] * 3 + [0.0])
        for a, b in ((PSI, PSI), (PSI, PSI_FRAME), (PSI_FRAME, PSI), (PSI_FRAME, PSI_FRAME)):
            P[i, a, i, b] = sigma_frames[1] ** 2  # the body turns with its frame
        P[i, PSI, i, PSI] += sigma_odometry[1] ** 2
    for body in known:
        for pinned in (PSI_FRAME, P_FRAME):
            x[body, pinned] = 0.0
            P[body, pinned] = 0.0
            P[:, :, body, pinned] = 0.0
        P[body, PSI, body, PSI] = sigma_odometry[1] ** 2
        x[body, PSI] = odometry[body, 3]
    return State(x.ravel(), P.reshape(8 * bodies, 8 * bodies), station)


class _Jacobian(NamedTuple):
    """What of B is the same at every tick, and where (in the flattened array) the rest goes."""

    constant: Array  # (4B, 8B)
    turn: npt.NDArray[np.intp]  # (6, B) entries cos, -sin, sin, cos, and the two of the frame's yaw


@lru_cache(maxsize=64)
def _jacobian(bodies: int) -> _Jacobian:
    B = np.zeros((bodies, 4, bodies, 8))
    every = np.arange(bodies)
    B[every, 2, every, 2] = 1.0
    B[every[:, None], (0, 1, 2), every[:, None], (4, 5, 6)] = 1.0
    B[every, 3, every, PSI] = 1.0
    at = np.arange(B.size).reshape(B.shape)
    places = ((0, 0), (0, 1), (1, 0), (1, 1), (0, PSI_FRAME), (1, PSI_FRAME))
    turn = np.array([at[every, row, every, column] for row, column in places])
    return _Jacobian(B.reshape(4 * bodies, 8 * bodies), turn)


def poses_jacobian(state: State) -> Array:
    """B (4B, 8B) = dy/dx at the mean."""
    s = state.by_body
    c, sn = np.cos(s[:, PSI_FRAME]), np.sin(s[:, PSI_FRAME])
    turned_x, turned_y = c * s[:, 0] - sn * s[:, 1], sn * s[:, 0] + c * s[:, 1]
    jacobian = _jacobian(state.bodies)
    B = jacobian.constant.copy()
    B.ravel()[jacobian.turn] = c, -sn, sn, c, -turned_y, turned_x
    return B
