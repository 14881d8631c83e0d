"""What do we expect to be measured? Predicted measurement, its covariance, its covariance with the state.

The paper spreads sigma points over the whole state (Sec. V-A step 2). A detection depends on the station and one
target only and is nonlinear only in yaws; sigma points over all entries lie sqrt(n) standard deviations out and wrap.
So: while yaws are uncertain, the exact moments, in closed form for Gaussian angles; once their variance is below
`LINEAR_YAW_VARIANCE`, the linear form, which is then the same to 2 parts in a thousand.

The exact form. For jointly Gaussian angles theta and complex q (x + iy), with variance v, complex covariance
c = cov(theta, q):

    E[e^{i theta} q] = e^{i m - v/2} (E[q] + i c)

and products of two such terms follow with theta_j -+ theta_k in place of theta. The covariance with the state needs
only the expected Jacobian: P_xz = P E[J]^T (Stein).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from agent.estimator.state import P_FRAME, P_ODOM, PSI, PSI_FRAME, Poses, State, poses_jacobian
from agent.interface.frames import Array, rotate_z

LINEAR_YAW_VARIANCE = 1e-3  # rad^2

Complex = npt.NDArray[np.complex128]


class Turned(NamedTuple):
    """Moments of n vectors e^{i theta} q, each turned about z by its own Gaussian angle."""

    mean: Array  # (n, 3)
    cov: Array  # (3n, 3n)
    factor: Complex  # (n,) E[e^{i theta}]
    derivative: Complex  # (n,) E[d/dtheta e^{i theta} q_xy]


def turned_vectors(theta: Array, q: Array, cov: Array) -> Turned:
    """Exact moments of Rz(theta_j) q_j.

    Args:
        theta: (n,) mean angles, rad.
        q: (n, 3) mean vectors.
        cov: (4n, 4n) joint covariance of [q_j (3), theta_j], n times.
    """
    n = len(theta)
    blocks = cov.reshape(n, 4, n, 4)
    V = blocks[:, 3, :, 3]  # of angles
    c = blocks[:, 3, :, 0] + 1j * blocks[:, 3, :, 1]  # (n, n): cov(theta_j, q_k)
    cz = blocks[:, 3, :, 2]
    K = blocks[:, 0, :, 0] + blocks[:, 1, :, 1] + 1j * (blocks[:, 1, :, 0] - blocks[:, 0, :, 1])  # E q~ conj q~
    Kp = blocks[:, 0, :, 0] - blocks[:, 1, :, 1] + 1j * (blocks[:, 1, :, 0] + blocks[:, 0, :, 1])  # E q~ q~
    Kz = blocks[:, 0, :, 2] + 1j * blocks[:, 1, :, 2]  # E q~_j z~_k
    m = q[:, 0] + 1j * q[:, 1]
    v = np.diag(V)
    own = np.diag(c)
    factor = np.exp(1j * theta - v / 2)
    mean = factor * (m + 1j * own)

    difference = np.exp(1j * (theta[:, None] - theta) - (v[:, None] + v - 2 * V) / 2)
    total = np.exp(1j * (theta[:, None] + theta) - (v[:, None] + v + 2 * V) / 2)
    # cov(angle combination, q_j) for rows j and q_k for columns k
    left, right = own[:, None] - c.T, c - own
    hermitian = difference * ((m[:, None] + 1j * left) * (m.conj() + 1j * right.conj()) + K)
    hermitian -= mean[:, None] * mean.conj()
    left, right = own[:, None] + c.T, c + own
    pseudo = total * ((m[:, None] + 1j * left) * (m + 1j * right) + Kp) - mean[:, None] * mean
    with_z = factor[:, None] * (1j * cz * (m + 1j * own)[:, None] + Kz)

    out = np.empty((n, 3, n, 3))
    out[:, 0, :, 0] = (hermitian + pseudo).real / 2
    out[:, 1, :, 1] = (hermitian - pseudo).real / 2
    out[:, 1, :, 0] = (pseudo + hermitian).imag / 2
    out[:, 0, :, 1] = (pseudo - hermitian).imag / 2
    out[:, 0, :, 2], out[:, 1, :, 2] = with_z.real, with_z.imag
    out[:, 2, :, 0], out[:, 2, :, 1] = with_z.real.T, with_z.imag.T
    out[:, 2, :, 2] = blocks[:, 2, :, 2]
    mean3 = np.column_stack([mean.real, mean.imag, q[:, 2]])
    return Turned(mean3, out.reshape(3 * n, 3 * n), factor, 1j * mean)


class PoseMoments(NamedTuple):
    poses: Poses
    P_xy: Array  # (8B, 4B)


def pose_moments(state: State) -> PoseMoments:
    """Moments of all poses in the common frame, from the state."""
    s = state.by_body
    B = poses_jacobian(state)
    if state.P[PSI_FRAME::8, PSI_FRAME::8].diagonal().max() <= LINEAR_YAW_VARIANCE:
        P_xy = state.P @ B.T
        y = s[:, :4].copy()
        y[:, :3] = rotate_z(s[:, PSI_FRAME], s[:, P_ODOM]) + s[:, P_FRAME]
        return PoseMoments(Poses(y.ravel(), B @ P_xy), P_xy)
    bodies = state.bodies
    entries = np.arange(8 * bodies).reshape(bodies, 8)
    arm = entries[:, (0, 1, 2, PSI_FRAME)].ravel()
    turned = turned_vectors(s[:, PSI_FRAME], s[:, P_ODOM], state.P[np.ix_(arm, arm)])
    blocks = B.reshape(bodies, 4, bodies, 8)
    every = range(bodies)
    blocks[every, 0, every, 0] = blocks[every, 1, every, 1] = turned.factor.real
    blocks[every, 1, every, 0], blocks[every, 0, every, 1] = turned.factor.imag, -turned.factor.imag
    blocks[every, 0, every, PSI_FRAME] = turned.derivative.real
    blocks[every, 1, every, PSI_FRAME] = turned.derivative.imag
    P_xy = state.P @ B.T
    y = np.column_stack([turned.mean + s[:, P_FRAME], s[:, PSI]])
    # cov(y) = the turned arms' exact covariance + what involves the rest, which enters linearly
    rest = np.zeros((bodies, 4, 8 * bodies))
    rest[every, 0, entries[:, 4]] = rest[every, 1, entries[:, 5]] = rest[every, 2, entries[:, 6]] = 1.0
    rest[every, 3, entries[:, PSI]] = 1.0
    linear = rest.reshape(4 * bodies, 8 * bodies)
    arms = B - linear
    cross = arms @ state.P @ linear.T
    Sigma = linear @ state.P @ linear.T + cross + cross.T
    Sigma.reshape(bodies, 4, bodies, 4)[:, :3, :, :3] += turned.cov.reshape(bodies, 3, bodies, 3)
    return PoseMoments(Poses(y.ravel(), Sigma), P_xy)


def lifted(state: State, before: PoseMoments, after: Poses) -> State:
    """The state given what the tick's detections changed in the poses: exact for jointly Gaussian (x, y)."""
    Sigma = before.poses.Sigma
    factor, info = lapack.dpotrf(Sigma, lower=1, clean=1)
    assert info == 0, "the covariance of the poses is not positive definite"
    Gt, _ = lapack.dpotrs(factor, before.P_xy.T, lower=1)
    x = state.x + (after.y - before.poses.y) @ Gt
    P = state.P - Gt.T @ (Sigma - after.Sigma) @ Gt
    P += P.T
    P *= 0.5
    return State(x, P, state.station)


class DetectionMoments(NamedTuple):
    """Of the noise-free detections of L targets by one station, in levelled axes (turned by its mean yaw)."""

    z_hat: Array  # (L, 3) m
    P_zz: Array  # (3L, 3L) m^2, without sensor noise
    P_yz: Array  # (4B, 3L)


class DetectionGeometry:
    """The constant part of H for one station and its targets, kept from tick to tick; the last body is nobody's."""

    def __init__(self, bodies: int, station: int) -> None:
        self.own = station - 1
        self.targets = np.array([j for j in range(bodies - 1) if j != self.own], dtype=np.intp)
        self.yaw_row = 4 * self.own + 3
        Ht = np.zeros((bodies, 4, len(self.targets), 3))
        for column, j in enumerate(self.targets):
            Ht[j, :3, column] = np.eye(3)
            Ht[self.own, :3, column] = -np.eye(3)
        self.Ht = Ht.reshape(4 * bodies, 3 * len(self.targets))  # H transposed; its yaw row is rewritten at each use


@lru_cache(maxsize=256)
def detection_geometry(bodies: int, station: int) -> DetectionGeometry:
    return DetectionGeometry(bodies, station)


def detection_moments(poses: Poses, geometry: DetectionGeometry) -> DetectionMoments:
    """Moments for the targets of this station."""
    by_body = poses.by_body
    lines = by_body[geometry.targets, :3] - by_body[geometry.own, :3]
    if poses.Sigma[geometry.yaw_row, geometry.yaw_row] > LINEAR_YAW_VARIANCE:
        return _exact_detection_moments(poses, geometry, lines)
    Ht = geometry.Ht
    yaw_row = Ht[geometry.yaw_row]
    yaw_row[0::3] = lines[:, 1]
    yaw_row[1::3] = -lines[:, 0]
    P_yz = poses.Sigma @ Ht
    return DetectionMoments(lines, Ht.T @ P_yz, P_yz)


def _exact_detection_moments(poses: Poses, geometry: DetectionGeometry, lines: Array) -> DetectionMoments:
    """Every line of sight is turned by the same angle, minus the station's yaw error."""
    n, bodies = len(lines), len(poses.y) // 4
    select = np.zeros((n, 4, 4 * bodies))
    Ht = geometry.Ht.copy()
    Ht[geometry.yaw_row] = 0.0
    select[:, :3] = Ht.T.reshape(n, 3, 4 * bodies)
    select[:, 3, geometry.yaw_row] = -1.0
    joint = select.reshape(4 * n, 4 * bodies)
    turned = turned_vectors(np.zeros(n), lines, joint @ poses.Sigma @ joint.T)
    shrink = turned.factor.real
    Ht[:, 0::3] *= shrink
    Ht[:, 1::3] *= shrink
    Ht[geometry.yaw_row, 0::3] = -turned.derivative.real
    Ht[geometry.yaw_row, 1::3] = -turned.derivative.imag
    return DetectionMoments(turned.mean, turned.cov, poses.Sigma @ Ht)
