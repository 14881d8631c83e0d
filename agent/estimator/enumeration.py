"""What does the update give without hypothesis evaluation? Every hypothesis, one by one: the plain twin of cpdaf.py.

There are sum over D of C(L, D) C(M, D) D! of them without gates (the paper prints C(L, D) twice): 1.4 million for 8
targets and 8 detections. They are taken in chunks, grouped by which targets they detect.
"""

from functools import lru_cache
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array

CHUNK = 50_000


class Enumerated(NamedTuple):
    g: Array  # (3L,)
    W: Array  # (3L, 3L)
    log_total: float  # log of the sum of all weights
    best: npt.NDArray[np.intp]  # (L,) the heaviest hypothesis; -1 is missed
    hypotheses: int  # how many there were


def enumerate_all(
    S: Array, innovations: Array, P_D: Array, clutter: float, inside: npt.NDArray[np.bool_]
) -> Enumerated:
    """Moments over all hypotheses that the gates admit; arguments as in `cpdaf.associate`, inside (L, M)."""
    L, M = inside.shape
    top, total, hypotheses = -np.inf, 0.0, 0
    g, B_sum, yy = np.zeros(3 * L), np.zeros((3 * L, 3 * L)), np.zeros((3 * L, 3 * L))
    best = np.full(L, -1, dtype=np.intp)
    for phi in product((False, True), repeat=L):
        targets = np.flatnonzero(phi)
        if len(targets) > M or (P_D[targets] == 0).any():
            continue
        missed = np.log1p(-P_D[~np.array(phi, dtype=bool)]).sum()
        rows = (3 * targets[:, None] + np.arange(3)).ravel()
        precision = np.linalg.inv(S[np.ix_(rows, rows)])
        log_phi = (
            missed
            + np.log(P_D[targets] / clutter).sum()
            - 0.5 * (np.linalg.slogdet(S[np.ix_(rows, rows)])[1] + len(rows) * np.log(2 * np.pi))
        )
        choices = _choices(M, len(targets))
        admitted = choices[inside[targets, choices].all(1)]
        for start in range(0, len(admitted), CHUNK):
            chosen = admitted[start : start + CHUNK]
            mu = innovations[targets, chosen].reshape(len(chosen), len(rows))
            y = mu @ precision
            log_weight = log_phi - 0.5 * (y * mu).sum(1)
            heaviest = int(log_weight.argmax())
            if log_weight[heaviest] > top:
                scale = np.exp(top - log_weight[heaviest])
                top = float(log_weight[heaviest])
                total, g, B_sum, yy = total * scale, g * scale, B_sum * scale, yy * scale
                best[:] = -1
                best[targets] = chosen[heaviest]
            weight = np.exp(log_weight - top)
            total += weight.sum()
            hypotheses += len(chosen)
            g[rows] += weight @ y
            B_sum[np.ix_(rows, rows)] += weight.sum() * precision
            yy[np.ix_(rows, rows)] += (y * weight[:, None]).T @ y
    g /= total
    return Enumerated(g, B_sum / total - yy / total + np.outer(g, g), float(top + np.log(total)), best, hypotheses)


@lru_cache(maxsize=32)
def _choices(M: int, D: int) -> npt.NDArray[np.intp]:
    """All ordered choices (n, D) of D of M detections."""
    rows = list(permutations(range(M), D))
    return np.array(rows, dtype=np.intp).reshape(len(rows), D)
