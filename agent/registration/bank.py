"""How well does each joint hypothesis explain what is seen? A small coupled filter for each, scored by its evidence.

A hypothesis is a Gaussian over the current poses of all MAVs it places, and of the start, in the station's odometry
frame, whose drift moves everybody else (`estimator/prediction.py`). All hypotheses of a bank are updated in one batch:
predict, associate softly (`association.py`), one Gauss-Newton step on all detection sets, and the Laplace evidence of
the tick,

    e = sum_i log Z_i(x+) - 1/2 |x+ - x|^2_P + 1/2 log |P^-1| - 1/2 log |A|,      A = P^-1 + sum b H' R^-1 H

which is comparable between hypotheses, because each pays for the drift that it needs and for how wide it was.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.config import COASTING_SIGMA, AgentConfig
from agent.interface.frames import Array, rotate_z, wrap
from agent.registration import views
from agent.registration.association import Soft, soft_assignment
from agent.registration.candidates import Placement
from agent.registration.window import Frame, carried

PRIOR_SIGMA_M, PRIOR_SIGMA_PER_M, PRIOR_SIGMA_RAD = 0.08, 0.05, 0.04  # of a placement, by distance
GATE = 25.0  # squared Mahalanobis distance beyond which a detection cannot be a target's
Mask = npt.NDArray[np.bool_]


@dataclass
class Bank:
    """K hypotheses over B = N + 1 bodies: the station (pinned to its odometry), the other MAVs, the start."""

    y: Array  # (K, B, 4)
    P: Array  # (K, 4N, 4N) of all but the station
    placed: Mask  # (K, N)

    @property
    def size(self) -> int:
        return len(self.y)

    def of(self, which: list[int]) -> "Bank":
        return Bank(self.y[which], self.P[which], self.placed[which])

    def joined(self, other: "Bank") -> "Bank":
        return Bank(
            np.concatenate([self.y, other.y]),
            np.concatenate([self.P, other.P]),
            np.concatenate([self.placed, other.placed]),
        )


@dataclass
class Explained:
    """How one tick went, by hypothesis."""

    evidence: Array  # (K,) nats
    expected: Array  # (K, N, N) P_D of every station-target pair whose set was heard, 0 for the others
    explained: Array  # (K, N, N) probability that the target was detected by the station
    square: Array  # (K,) sum of normalised squared residuals
    events: Array  # (K,) how many detections that were


class Filter:
    """What is the same for all hypotheses and ticks."""

    def __init__(self, config: AgentConfig, mavs: int, rate_hz: float) -> None:
        self._detector, self._mavs = config.detector, mavs
        reading = np.array([config.filter.odometry_sigma_m] * 3 + [config.filter.odometry_sigma_rad]) ** 2
        drift = np.array([config.odometry.position_sigma_m] * 3 + [config.odometry.yaw_sigma_rad]) ** 2
        self._drift = drift + 2 * reading
        self._coasting = np.repeat(np.divide(COASTING_SIGMA, rate_hz) ** 2, (3, 1))

    def step(self, bank: Bank, before: Frame, frame: Frame) -> Explained:
        """Moves the bank from one frame to the next and updates it with that one's detections."""
        self.predict(bank, before, frame)
        return self.update(bank, frame)

    def explained(self, bank: Bank, frame: Frame) -> tuple[Array, Array]:
        """(N, N) P_D of every station-target pair whose set was heard, and the probability that the detection is there;
        by the first hypothesis."""
        here = self._predicted(bank, frame)
        S = _covariances(bank.P, here, _Slopes.at(here))
        soft = soft_assignment(self._odds(here, frame, *_normalised(here.nu, S)))
        return here.P_D[0], soft.belief[0].sum(-1)

    def predict(self, bank: Bank, before: Frame, frame: Frame) -> None:
        K, N = bank.size, self._mavs
        y = bank.y
        increments = frame.odometry[1:] - before.odometry[1:]
        moved = rotate_z(y[:, 1:N, 3] - before.odometry[1:, 3], increments[:, :3])
        y[:, 1:N, :3] += moved
        y[:, 1:N, 3] += wrap(increments[:, 3])
        y[:, 0] = frame.odometry[0]
        P = bank.P.reshape(K, N, 4, N, 4)
        for axis, lever in ((0, -moved[..., 1]), (1, moved[..., 0])):
            P[:, : N - 1, axis] += lever[..., None, None] * P[:, : N - 1, 3]
        for axis, lever in ((0, -moved[..., 1]), (1, moved[..., 0])):
            P[:, :, :, : N - 1, axis] += lever[:, None, None] * P[:, :, :, : N - 1, 3]
        own = np.tile(self._drift, (N - 1, 1))
        own[~(frame.read & before.read)[1:]] += self._coasting
        every = np.arange(4 * N - 4)
        bank.P[:, every, every] += own.ravel()
        # The station's own drift moves everybody else in its frame.
        Gamma = np.zeros((K, N, 4, 4))
        Gamma[..., (0, 1, 2, 3), (0, 1, 2, 3)] = 1.0
        Gamma[..., 3, 3] = -1.0
        arm = y[:, :1, :2] - y[:, 1:, :2]
        Gamma[..., 0, 3], Gamma[..., 1, 3] = -arm[..., 1], arm[..., 0]
        Gamma = (Gamma * np.sqrt(self._drift)).reshape(K, 4 * N, 4)
        bank.P += Gamma @ Gamma.transpose(0, 2, 1)

    def update(self, bank: Bank, frame: Frame, iterations: int = 1) -> Explained:
        K, N = bank.size, self._mavs
        every = np.arange(4 * N)
        prior_mean, L = bank.y.copy(), np.linalg.cholesky(bank.P)
        P, dx = bank.P, np.zeros((K, 4 * N))
        for _ in range(iterations):
            here = self._predicted(bank, frame)
            slopes = _Slopes.at(here)
            soft = soft_assignment(self._odds(here, frame, *_normalised(here.nu, _covariances(P, here, slopes))))
            M, g = _information(soft, here, slopes)
            if dx.any():
                g += (M @ dx[..., None])[..., 0]
            A = L.transpose(0, 2, 1) @ M @ L  # of the prior's units: I + this is what is known afterwards
            A[:, every, every] += 1.0
            C = np.linalg.cholesky(A)
            X = np.linalg.solve(C, L.transpose(0, 2, 1))
            P = X.transpose(0, 2, 1) @ X
            dx = (P @ g[..., None])[..., 0]
            bank.y = prior_mean.copy()
            bank.y[:, 1:] += dx.reshape(K, N, 4)
        bank.P = P
        moved = (dx * (g - (M @ dx[..., None])[..., 0])).sum(1)  # squared, by the prior's covariance
        here = self._predicted(bank, frame)
        square = here.nu.square(here.R)
        soft = soft_assignment(self._odds(here, frame, square, here.R.prod(-1)))
        log_Z = soft.log_normaliser.sum(1) + np.log1p(-here.P_D).sum((1, 2))
        evidence = log_Z - 0.5 * moved - np.log(C[:, every, every]).sum(1)
        used = soft.belief > 0.5
        return Explained(
            evidence, here.P_D, soft.belief.sum(-1), np.where(used, square, 0.0).sum((1, 2, 3)), used.sum((1, 2, 3))
        )

    def _predicted(self, bank: Bank, frame: Frame) -> "_Predicted":
        """At the bank's current means."""
        y = bank.y[:, : self._mavs]
        spherical = views.predicted(y[:, :, None, :3], y[:, None, :, :3])
        yaw = y[:, :, None, 3]
        P_D = views.detection_probability(self._detector, spherical, yaw)
        P_D = np.where(bank.placed[:, :, None] & bank.placed[:, None] & frame.heard[:, None], P_D, 0.0)
        diagonal = np.arange(self._mavs)
        P_D[:, diagonal, diagonal] = 0.0
        nu = views.residuals(spherical, np.broadcast_to(yaw, P_D.shape), frame.spherical[None, :, None])
        return _Predicted(spherical, nu, views.noise(self._detector, spherical[..., 0]), P_D)

    def _odds(self, here: "_Predicted", frame: Frame, square: Array, determinant: Array) -> Array:
        """(K, N, N, M) odds of every detection to be of every target against missed and false, from nu' S^-1 nu
        (K, N, N, M) and |S| (K, N, N)."""
        kappa = views.clutter(self._detector, frame.spherical[..., 0])[:, None]
        scale = here.P_D / (1 - here.P_D) / np.sqrt((2 * np.pi) ** 3 * determinant)
        return np.where(square < GATE, np.exp(-0.5 * square) * scale[..., None] / kappa, 0.0)  # NaN compares false


class _Predicted(NamedTuple):
    """What every station (i) should see of every target (j), and how the detections differ."""

    spherical: Array  # (K, N, N, 3) common axes
    nu: views.Residuals  # (K, N, N, M)
    R: Array  # (K, N, N, 3) variances of nu
    P_D: Array  # (K, N, N)


class _Slopes(NamedTuple):
    """Derivatives of what is predicted: G by the target's position, -G by the station's, -lever by its yaw (azimuth
    alone)."""

    G: Array  # (K, N, N, 3, 3)
    lever: Array  # (K, N, N)

    @staticmethod
    def at(here: _Predicted) -> "_Slopes":
        return _Slopes(views.axes(here.spherical), np.cos(here.spherical[..., 2]))


def _covariances(P: Array, here: _Predicted, slopes: _Slopes) -> Array:
    """S (K, N, N, 3, 3) of every pair's residual."""
    K, N = here.P_D.shape[:2]
    full = np.zeros((K, N, N, 4, 4))  # (K, i, j, ...): station and target, the station's own pose being certain
    full[:, 1:, 1:] = P.reshape(K, N, 4, N, 4)[:, : N - 1, :, : N - 1].transpose(0, 1, 3, 2, 4)
    own = full[:, np.arange(N), np.arange(N)]
    position = full[..., :3, :3]
    apart = own[:, :, None, :3, :3] + own[:, None, :, :3, :3] - position - position.swapaxes(1, 2)
    with_yaw = own[:, :, None, :3, 3] - full[..., 3, :3]  # of the line of sight and the station's yaw, negative
    G, lever = slopes
    S = G @ apart @ G.swapaxes(-1, -2)
    turned = lever[..., None] * (G @ with_yaw[..., None])[..., 0]
    turned[..., 1] += 0.5 * lever**2 * own[:, :, None, 3, 3]
    S[..., 1, :] += turned
    S[..., :, 1] += turned
    S[..., (0, 1, 2), (0, 1, 2)] += here.R
    return S


def _information(soft: Soft, here: _Predicted, slopes: _Slopes) -> tuple[Array, Array]:
    """Of all detections, weighted by belief: matrix (K, 4N, 4N) and vector (K, 4N), without the station's rows."""
    K, N = here.P_D.shape[:2]
    every, (G, lever) = np.arange(N), slopes
    weight = soft.belief.sum(-1)[..., None] / here.R
    some = soft.belief > 0
    mean = np.stack([(np.where(some, part, 0.0) * soft.belief).sum(-1) for part in here.nu], axis=-1) / here.R
    weighted = G * weight[..., None]
    W = G.swapaxes(-1, -2) @ weighted
    W += W.transpose(0, 2, 1, 3, 4)  # i of j, and j of i
    with_yaw = weighted[..., 1, :] * lever[..., None]
    M, g = np.zeros((K, N + 1, 4, N + 1, 4)), np.zeros((K, N + 1, 4))
    M[:, :N, :3, :N, :3] = -W.transpose(0, 1, 3, 2, 4)
    M[:, every, :3, every, :3] = W.sum(2).transpose(1, 0, 2, 3)
    M[:, :N, 3, :N, :3] = -with_yaw
    M[:, every, 3, every, :3] = with_yaw.sum(2)
    M[:, :N, :3, :N, 3] = M[:, :N, 3, :N, :3].transpose(0, 2, 3, 1)
    M[:, every, 3, every, 3] = (weight[..., 1] * lever**2).sum(2)
    along = (mean[..., None, :] @ G)[..., 0, :]
    g[:, :N, :3] = along.sum(1) - along.sum(2)
    g[:, :N, 3] = -(lever * mean[..., 1]).sum(2)
    return M[:, 1:, :, 1:].reshape(K, 4 * N, 4 * N), g[:, 1:].reshape(K, 4 * N)


def _normalised(nu: views.Residuals, S: Array) -> tuple[Array, Array]:
    """nu' S^-1 nu (..., M) and |S| (...) of symmetric matrices S (..., 3, 3)."""
    a, b, c = S[..., 0, 0], S[..., 0, 1], S[..., 0, 2]
    d, e, f = S[..., 1, 1], S[..., 1, 2], S[..., 2, 2]
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * A + b * B + c * C
    of = [
        (part / determinant)[..., None] for part in (A, 2 * B, 2 * C, a * f - c * c, 2 * (b * c - a * e), a * d - b * b)
    ]
    x, y, z = nu
    return x * (of[0] * x + of[1] * y + of[2] * z) + y * (of[3] * y + of[4] * z) + of[5] * z * z, determinant


@dataclass
class Team:
    """Whom the station has localised already, and how well: the beginning of every hypothesis."""

    y: Array  # (B, 4) at the newest frame
    P: Array  # (4N, 4N) of all but the station; zero for who is not placed
    placed: Mask  # (N,), the station among them


def begin(placements: list[Placement], team: Team, newest: Frame, frame: Frame) -> Bank:
    """The hypotheses that these placements (at the newest frame) make, as they were at an earlier frame."""
    K, N = len(placements), len(team.placed)
    y = np.tile(team.y, (K, 1, 1))
    P = np.tile(team.P, (K, 1, 1))
    placed = np.array([p.placed for p in placements])
    for k, placement in enumerate(placements):
        new = np.flatnonzero(placement.placed & ~team.placed)
        y[k, new] = placement.poses[new]
        bases = np.flatnonzero(team.placed)
        lines = placement.poses[new, None, :3] - placement.poses[None, bases, :3]
        distance = np.linalg.norm(lines, axis=-1).min(1)
        sigma = np.tile(PRIOR_SIGMA_RAD, (len(new), 4))
        sigma[:, :3] = (PRIOR_SIGMA_M + PRIOR_SIGMA_PER_M * distance)[:, None]
        for j, s in zip(new, sigma, strict=True):
            rows = slice(4 * j - 4, 4 * j)
            P[k, rows, rows] = np.diag(s**2)
        for j in np.flatnonzero(~placement.placed):
            rows = slice(4 * j - 4, 4 * j)
            P[k, rows, rows] = np.eye(4)  # of no meaning, but invertible
    y[:, :N] = carried(y[:, :N], newest.odometry, frame.odometry)
    return Bank(y, P, placed)
