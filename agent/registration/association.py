"""Which detection is which target's, softly? Belief propagation for one set's one-to-one associations.

Marginals and normaliser of all feasible hypotheses, without enumerating them (Williams and Lau 2014, "Approximate
evaluation of marginal association probabilities with belief propagation"; the normaliser is Bethe's). Exact where
targets do not share detections.
"""

from typing import NamedTuple

import numpy as np

from agent.interface.frames import Array

SWEEPS, CONVERGED = 30, 1e-6


class Soft(NamedTuple):
    belief: Array  # (..., L, M) probability that detection m is target l's
    log_normaliser: Array  # (...) log of the sum over all hypotheses, relative to "nothing was detected"


def soft_assignment(w: Array) -> Soft:
    """For odds w (..., L, M) of "m is l's" against "l was missed and m is false"."""
    nu = np.ones_like(w)
    for _ in range(SWEEPS):
        wn = w * nu
        mu = w / np.maximum(1.0 + wn.sum(-1, keepdims=True) - wn, 1.0)
        before, nu = nu, 1.0 / np.maximum(1.0 + mu.sum(-2, keepdims=True) - mu, 1.0)
        if np.abs(nu - before).max(initial=0.0) < CONVERGED:
            break
    wn = w * nu
    total = 1.0 + wn.sum(-1)
    belief = wn / total[..., None]
    log_normaliser = np.log(total).sum(-1) + np.log1p(mu.sum(-2)).sum(-1) - np.log1p(mu * nu).sum((-2, -1))
    return Soft(belief, log_normaliser)
