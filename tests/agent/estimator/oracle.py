"""The CPDAF update as the paper states it: one Kalman posterior per hypothesis, then the moments of the mixture."""

from itertools import permutations, product
from typing import NamedTuple

import numpy as np


class Case(NamedTuple):
    x: np.ndarray  # (n,)
    P: np.ndarray  # (n, n)
    P_xz: np.ndarray  # (n, 3L)
    S: np.ndarray  # (3L, 3L)
    innovations: np.ndarray  # (L, M, 3)
    P_D: np.ndarray  # (L,)
    clutter: float


class Mixture(NamedTuple):
    x: np.ndarray
    P: np.ndarray
    hypotheses: int
    reach: float  # largest distance of a hypothesis's mean from x, at least 1e-3
    evidence: float


def random_case(rng, L, M, spread=1.0, P_D=None):
    """A team of L targets and a station that makes their innovations correlated, with M detections near or far."""
    n = 3 * (L + 1) + 2
    root = rng.normal(size=(n, n)) * 0.3
    P = root @ root.T + 0.01 * np.eye(n)
    H = np.zeros((3 * L, n))
    for j in range(L):
        H[3 * j : 3 * j + 3, 3 * (j + 1) : 3 * (j + 2)] = np.eye(3)
        H[3 * j : 3 * j + 3, :3] = -np.eye(3)
        H[3 * j : 3 * j + 3, -2] = rng.normal(size=3)
    S = H @ P @ H.T
    for j in range(L):
        u = rng.normal(size=3)
        S[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] += 0.02 * np.outer(u, u) + 0.003 * np.eye(3)
    places = rng.normal(size=(L, 3)) * 3
    offsets = np.linalg.cholesky(S) @ rng.normal(size=3 * L) if L else np.zeros(0)
    true = places + offsets.reshape(L, 3)
    picks = [true[j] if j < L else rng.normal(size=3) * 3 for j in rng.permutation(max(L, M))[:M]]
    detections = np.array(picks).reshape(M, 3) + 0.05 * spread * rng.normal(size=(M, 3))
    innovations = detections[None] - places[:, None]
    P_D = rng.uniform(0.5, 0.95, L) if P_D is None else P_D
    return Case(rng.normal(size=n), P, P @ H.T, S, innovations, P_D, float(10 ** rng.uniform(-4, -1)))


def mixture(case, inside):
    """All hypotheses within the gates, (L, M) bool."""
    L, M = inside.shape
    weights, means, covariances = [], [], []
    for phi in product((False, True), repeat=L):
        targets = [t for t in range(L) if phi[t]]
        D = len(targets)
        rows = [3 * t + k for t in targets for k in range(3)]
        S = case.S[np.ix_(rows, rows)]
        for chosen in permutations(range(M), D):
            if not all(inside[t, m] for t, m in zip(targets, chosen, strict=True)):
                continue
            prior = np.prod([case.P_D[t] if phi[t] else 1 - case.P_D[t] for t in range(L)])
            if prior == 0:
                continue
            mu = np.concatenate([case.innovations[t, m] for t, m in zip(targets, chosen, strict=True)] or [np.zeros(0)])
            likelihood = np.exp(-0.5 * mu @ np.linalg.solve(S, mu)) / np.sqrt(np.linalg.det(2 * np.pi * S)) if D else 1
            weights.append(prior * likelihood * case.clutter ** (M - D))
            K = case.P_xz[:, rows] @ np.linalg.inv(S) if D else np.zeros((len(case.x), 0))
            means.append(case.x + K @ mu)
            covariances.append(case.P - K @ S @ K.T)
    beta = np.array(weights) / np.sum(weights)
    x = beta @ np.array(means)
    spread = np.array(means) - x
    P = np.tensordot(beta, np.array(covariances), 1) + (spread * beta[:, None]).T @ spread
    reach = max(np.abs(spread).max(), 1e-3)
    return Mixture(x, P, len(beta), float(reach), float(np.sum(weights)))
