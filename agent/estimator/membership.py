"""How does a MAV that has just been localised get into a filter that flies already?

From a joint Gaussian over newcomers and members only the distribution of the newcomers given the members is taken,
y_new | y_old ~ N(m_new + A (y_old - m_old), C). With nobody there before but the station, that is all of it.
"""

from typing import NamedTuple

import numpy as np

from agent.estimator.moments import pose_moments
from agent.estimator.state import P_FRAME, P_ODOM, PSI, PSI_FRAME, Poses, State
from agent.interface.frames import Array, rotate_z


class Conditional(NamedTuple):
    """y_new given y_old: mean + A (y_old - old_mean), covariance C."""

    mean: Array  # (4n,)
    old_mean: Array  # (4m,)
    A: Array  # (4n, 4m)
    C: Array  # (4n, 4n)


def conditional(y: Array, Sigma: Array, new: list[int], old: list[int]) -> Conditional:
    """Of bodies `new` given bodies `old`, from the joint distribution of all bodies: y (B, 4), Sigma (4B, 4B)."""
    n, m = _entries(new, 4), _entries(old, 4)
    cross = Sigma[np.ix_(n, m)]
    A = np.asarray(np.linalg.solve(Sigma[np.ix_(m, m)], cross.T).T, np.float64)
    C = Sigma[np.ix_(n, n)] - A @ cross.T
    return Conditional(y.ravel()[n], y.ravel()[m], A, (C + C.T) / 2)


def with_newcomers(
    state: State, poses: Poses, known: list[int], joint: Conditional, readings: Array, sigma: tuple[float, float]
) -> State:
    """The state with n more bodies, behind the others.

    Args:
        state: of B bodies.
        poses: what it says of their poses.
        known: the bodies of the state that `joint` calls old, in the same order.
        joint: of the newcomers given these.
        readings: (n, 4) the newcomers' odometry of this tick.
        sigma: standard deviation of a reading, per axis m and rad.
    """
    n, old = len(readings), _entries(known, 4)
    difference = poses.y[old] - joint.old_mean
    difference[3::4] = (difference[3::4] + np.pi) % (2 * np.pi) - np.pi
    y = (joint.mean + joint.A @ difference).reshape(n, 4)
    x = np.empty((n, 8))
    x[:, P_ODOM], x[:, PSI] = readings[:, :3], y[:, 3]
    x[:, PSI_FRAME] = y[:, 3] - readings[:, 3]
    arm = rotate_z(x[:, PSI_FRAME], readings[:, :3])
    x[:, P_FRAME] = y[:, :3] - arm
    # d x_new = T d y_new + E e, with e the error of the reading
    T, E = np.zeros((n, 8, n, 4)), np.zeros((n, 8, n, 4))
    for k in range(n):
        T[k, (4, 5, 6), k, (0, 1, 2)] = T[k, PSI, k, 3] = T[k, PSI_FRAME, k, 3] = 1.0
        turning = np.array([-arm[k, 1], arm[k, 0], 0.0])
        T[k, P_FRAME, k, 3], E[k, P_FRAME, k, 3] = -turning, turning
        E[k, (0, 1, 2), k, (0, 1, 2)], E[k, PSI_FRAME, k, 3] = 1.0, -1.0
        E[k, P_FRAME, k, :3] = -rotate_z(np.array(x[k, PSI_FRAME]), np.eye(3)).T
    flat_T, flat_E = T.reshape(8 * n, 4 * n), E.reshape(8 * n, 4 * n)
    R = np.tile([sigma[0] ** 2] * 3 + [sigma[1] ** 2], n)
    own = joint.A @ poses.Sigma[np.ix_(old, old)] @ joint.A.T + joint.C
    P_new = flat_T @ own @ flat_T.T + (flat_E * R) @ flat_E.T
    P_xy = pose_moments(state).P_xy[:, old]
    cross = P_xy @ joint.A.T @ flat_T.T  # (8B, 8n)
    return State(np.concatenate([state.x, x.ravel()]), np.block([[state.P, cross], [cross.T, P_new]]), state.station)


def _entries(bodies: list[int], each: int) -> list[int]:
    return [each * body + k for body in bodies for k in range(each)]
