"""How likely is a hypothesis? The exact weights beta of the paper's Sec. V-A step 4 (as corrected in cpdaf.py)."""

from typing import NamedTuple

import numpy as np

from agent.estimator.hypotheses import LOG_2PI_3_2, Assignments, Hypotheses
from agent.estimator.small_matrices import inverses
from agent.interface.frames import Array

MOST_NATS = 250.0  # odds so large are certainties, and their squares still finite


class Weighed(NamedTuple):
    g: Array  # (3L,)
    W: Array  # (3L, 3L)
    log_total: float  # log of the sum of all weights
    best: Assignments  # (L,) the heaviest hypothesis


def weigh(hypotheses: Hypotheses, S: Array, innovations: Array, P_D: Array, clutter: float) -> Weighed:
    """Exact weights of the given hypotheses, and their moments in measurement space; a group shares S(phi)^-1."""
    assigned, detected, starts, counts, both, neither = hypotheses
    L = len(P_D)
    padded = np.zeros((L, innovations.shape[1] + 1, 3))  # index MISSED, the last, stays zero
    padded[:, :-1] = innovations
    mu = padded[np.arange(L), assigned].reshape(len(assigned), 3 * L)
    masked = S * both
    diagonal = masked.reshape(len(masked), -1)[:, :: 3 * L + 1]
    diagonal += neither
    B = np.linalg.inv(masked)
    log_detected, log_missed = np.log(P_D / clutter) - LOG_2PI_3_2, np.log1p(-P_D)
    log_phi = detected @ (log_detected - log_missed) + log_missed.sum() - 0.5 * np.linalg.slogdet(masked)[1]
    B.reshape(len(B), -1)[:, :: 3 * L + 1] -= neither
    y = np.empty_like(mu)
    start = 0
    for k, count in enumerate(counts.tolist()):
        np.matmul(mu[start : start + count], B[k], out=y[start : start + count])
        start += count
    log_weight = log_phi.repeat(counts) - 0.5 * (mu * y).sum(1)
    top = log_weight.max()
    weight = np.exp(log_weight - top)
    total = weight.sum()
    beta = weight / total
    g = beta @ y
    B_mean = (np.add.reduceat(beta, starts) @ B.reshape(len(B), -1)).reshape(3 * L, 3 * L)
    W = B_mean - (y * beta[:, None]).T @ y + g[:, None] * g
    return Weighed(g, W, float(top + np.log(total)), assigned[beta.argmax()])


class Misses(NamedTuple):
    """For each of E associated pairs: the odds that the target was missed and the detection is false."""

    odds: Array  # (E,) against "all E detected", exact, given the other pairs
    u: Array  # (E, 3, 1) conditional innovation
    spread: Array  # (E, 3, 3) its covariance plus u u^T

    def two(self) -> float:
        """The weight of two misses at once, as if independent, relative to none; infinite if one is likely."""
        total = float(self.odds.sum())
        return (total * total - float(self.odds @ self.odds)) / 2 if total < 1 else np.inf


def miss_odds(A: Array, y: Array, P_D: Array, clutter: float) -> Misses:
    """Leave-one-out odds from the inverse innovation covariance of all pairs.

    Given the other pairs, the innovation of pair t has covariance A_tt^-1 and mean u = A_tt^-1 y_t.

    Args:
        A: (E, 3, 3) diagonal blocks of the inverse innovation covariance.
        y: (E, 3, 1) of that inverse times the innovation.
        P_D: (E,)
        clutter: false detections per m^3.
    """
    inverse = inverses(A)
    u = inverse.inverse @ y
    half_distance = 0.5 * (u * y).sum(1).ravel()
    likelihood = np.exp(np.minimum(LOG_2PI_3_2 + half_distance, MOST_NATS)) / np.sqrt(inverse.determinant)
    return Misses((1 - P_D) * clutter / P_D * likelihood, u, inverse.inverse + u * u.transpose(0, 2, 1))
