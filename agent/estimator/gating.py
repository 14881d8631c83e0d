"""Which detection may be of which target? (the paper, Sec. V-A step 2)

A detection is a candidate for a target if its squared Mahalanobis distance is inside the chi-square gate at P_G, on
the target's own block of the innovation covariance, sensor noise included (the paper's P_zz is silent on that).
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from agent.estimator.small_matrices import diagonal_blocks, inverses
from agent.interface.frames import Array


class Gates(NamedTuple):
    distance: Array  # (L, M) squared Mahalanobis distances
    inside: npt.NDArray[np.bool_]  # (L, M) candidates


def chi_square_quantile(probability: float, dof: float) -> float:
    return float(2 * gammaincinv(dof / 2, probability))


def gate(S: Array, innovations: Array, P_D: Array, threshold: float) -> Gates:
    """Candidates.

    Args:
        S: (3L, 3L) innovation covariance of all targets, sensor noise included, m^2.
        innovations: (L, M, 3) detection minus prediction, m.
        P_D: (L,) detection probabilities; what cannot be seen has no candidates.
        threshold: on the squared distance; infinite switches gating off.
    """
    S_inverse = inverses(diagonal_blocks(S)).inverse
    distance = ((innovations @ S_inverse) * innovations).sum(2)
    return Gates(distance, (distance <= threshold) & (P_D > 0)[:, None])
