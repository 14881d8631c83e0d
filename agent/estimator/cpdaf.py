"""How do anonymous detections change the belief? The CPDAF update (the paper, Sec. V-A step 4)

The weight of a hypothesis that detects the targets phi (D of them), with innovations mu, is

    beta  ~  N(mu; 0, S(phi)) lambda^(M - D) prod P_D^phi (1 - P_D)^(1 - phi)

and the update needs only moments in measurement space. With B_phi = S(phi)^-1 zero-padded to all targets, y = B_phi mu:

    g = sum beta y,    W = sum beta B_phi - (sum beta y y^T - g g^T),    x <- x + P_xz g,    P <- P - P_xz W P_xz^T

Deviations from the paper: the Gaussian has exp(-1/2 mu^T S^-1 mu) and (2 pi)^(3D) (it prints neither factor), the
clutter exponent is M - D (it prints L - D), the gain is (Phi P_zx)^T S(phi)^-1 (it prints P_zz^-1), and the spread term
is the closed one above (its brackets do not close). Here lambda^M, common to all hypotheses, is left out.

What is unambiguous is not enumerated. A target with one detection in its gate, which lies in no other gate, is
*certain* if the exact odds that it was missed after all (and the detection false) are negligible; certain targets make
one Kalman block, the rest are weighed given that block.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from agent.estimator.enumeration import enumerate_all
from agent.estimator.gating import gate
from agent.estimator.hypotheses import FEW, MISSED, candidates_of, combinations, every_hypothesis, grow_tree
from agent.estimator.small_matrices import diagonal_blocks, diagonal_index, inverses
from agent.estimator.weights import Misses, miss_odds, weigh
from agent.interface.frames import Array


class Association(NamedTuple):
    """What one detection set says, in measurement space; `rows` selects those of the 3L that it touches."""

    rows: npt.NDArray[np.intp]  # (R,)
    g: Array  # (R,) expected P_zz^-1-weighted innovation
    W: Array  # (R, R)
    lost_mass: float  # bound or, for what was taken as certain, estimate of the share of weight left out
    distances: Array  # squared Mahalanobis distances of the best hypothesis's innovations, each on its own


class Rules(NamedTuple):
    """How hypotheses are chosen."""

    gate_threshold: float  # squared Mahalanobis distance; infinite: no gating
    evaluation: bool  # off: every hypothesis within the gates is enumerated
    pruned_mass: float


def associate(S: Array, innovations: Array, P_D: Array, clutter: float, rules: Rules) -> Association:
    """Weighs all associations of one detection set.

    Args:
        S: (3L, 3L) innovation covariance, sensor noise included, m^2.
        innovations: (L, M, 3) every detection minus every prediction, m.
        P_D: (L,) detection probabilities; 0 where a target cannot be seen.
        clutter: density of false detections, 1/m^3.
        rules: gates and pruning.
    """
    if innovations.size == 0:
        return _nothing()
    gates = gate(S, innovations, P_D, rules.gate_threshold)
    if not rules.evaluation:
        moments = enumerate_all(S, innovations, P_D, clutter, gates.inside)
        best = moments.best
        detected = np.flatnonzero(best != MISSED)
        return Association(np.arange(len(S)), moments.g, moments.W, 0.0, gates.distance[detected, best[detected]])
    targets, detections = gates.inside.nonzero()
    if not len(targets):
        return _nothing()
    pairs = _Pairs(targets, detections)
    lone = pairs if rules.pruned_mass > 0 else pairs.none()
    if not pairs.one_to_one():
        in_target, in_detection = gates.inside.sum(1), gates.inside.sum(0)
        lone = lone.those((in_target[lone.targets] == 1) & (in_detection[lone.detections] == 1))
    certain = _certain(lone, S, innovations, P_D, clutter, rules.pruned_mass, len(lone.targets) == len(targets))
    if len(certain.pairs.targets) == len(targets):
        nis = gates.distance[certain.pairs.targets, certain.pairs.detections]
        return Association(certain.rows, certain.g, certain.W, certain.lost, nis)
    undecided = np.asarray(gates.inside.any(1))
    undecided[certain.pairs.targets] = False
    return _given_certain(
        certain, undecided.nonzero()[0], gates.inside, gates.distance, S, innovations, P_D, clutter, rules
    )


def told(S: Array, innovations: Array, labels: npt.NDArray[np.intp]) -> Association:
    """The update of a filter that is told which target each detection is (index 0..L-1, or -1 for a false one)."""
    detections = np.flatnonzero(labels >= 0)
    if not len(detections):
        return _nothing()
    pairs = _Pairs(labels[detections], detections)
    block = _kalman(pairs, S, innovations)
    nu = block.mu.reshape(-1, 3, 1)
    distance = (nu.transpose(0, 2, 1) @ inverses(diagonal_blocks(S)).inverse[pairs.targets] @ nu).ravel()
    return Association(block.rows, block.g, block.W, 0.0, distance)


class _Pairs(NamedTuple):
    """Targets, each with a detection that may be its own; a target may be in several pairs."""

    targets: npt.NDArray[np.intp]
    detections: npt.NDArray[np.intp]

    def one_to_one(self) -> bool:
        n = len(self.targets)
        return len(set(self.targets.tolist())) == n == len(set(self.detections.tolist()))

    def those(self, which: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> "_Pairs":
        return _Pairs(self.targets[which], self.detections[which])

    def none(self) -> "_Pairs":
        return _Pairs(self.targets[:0], self.detections[:0])


class _Certain(NamedTuple):
    """Targets whose detection is known, as one Kalman block; g and W may weigh single misses among them too."""

    pairs: _Pairs
    rows: npt.NDArray[np.intp]
    mu: Array  # (3C,) innovations
    A: Array  # (3C, 3C) inverse innovation covariance
    g: Array
    W: Array
    lost: float


def _kalman(pairs: _Pairs, S: Array, innovations: Array) -> _Certain:
    rows = (3 * pairs.targets[:, None] + _XYZ).ravel()
    whole = len(rows) == len(S) and bool((pairs.targets[1:] > pairs.targets[:-1]).all())
    factor, info = lapack.dpotrf(S if whole else S[rows[:, None], rows], lower=1, clean=1)
    assert info == 0, "the innovation covariance is not positive definite"
    inverse, _ = lapack.dtrtri(factor, lower=1)
    A = inverse.T @ inverse
    mu = innovations[pairs.targets, pairs.detections].ravel()
    return _Certain(pairs, rows, mu, A, A @ mu, A, 0.0)


def _certain(
    pairs: _Pairs, S: Array, innovations: Array, P_D: Array, clutter: float, negligible: float, complete: bool
) -> _Certain:
    """Those of the lone target-detection pairs whose odds of being a miss and a false detection are negligible.

    Where nothing but these pairs is at stake (`complete`) and two misses at once are negligible, single misses are
    weighed in: each takes one target out of the Kalman block.
    """
    while len(pairs.targets):
        block = _kalman(pairs, S, innovations)
        misses = miss_odds(diagonal_blocks(block.A), block.g.reshape(-1, 3, 1), P_D[pairs.targets], clutter)
        total = float(misses.odds.sum())
        if total <= negligible:
            return block._replace(lost=total)
        two = misses.two()
        if complete and two <= negligible:
            return _with_single_misses(block, misses, misses.odds / (1 + total), two)
        order = misses.odds.argsort()
        keep = misses.odds[order].cumsum() <= negligible
        pairs, complete = pairs.those(np.sort(order[keep])), False
    return _Certain(pairs.none(), _NO_ROWS, np.zeros(0), np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)), 0.0)


def _with_single_misses(block: _Certain, misses: Misses, beta: Array, lost: float) -> _Certain:
    """Moments over "all detected" and "all but t", each t with its weight beta."""
    U = (beta[:, None, None] * misses.u).ravel()
    D = np.outer(-U, U)
    D.ravel()[diagonal_index(len(beta))] += (beta[:, None, None] * misses.spread).reshape(-1, 9)
    A = block.A
    return block._replace(g=block.g - A @ U, W=A - A @ D @ A, lost=lost)


def _given_certain(
    certain: _Certain,
    uncertain: npt.NDArray[np.intp],
    inside: npt.NDArray[np.bool_],
    distance: Array,
    S: Array,
    innovations: Array,
    P_D: Array,
    clutter: float,
    rules: Rules,
) -> Association:
    """Weighs the uncertain targets in the space that is left to them once the certain ones are known."""
    rows = (3 * uncertain[:, None] + _XYZ).ravel()
    S_uu, nu = S[rows[:, None], rows], innovations[uncertain]
    V = S[rows[:, None], certain.rows] @ certain.A
    S_uu = S_uu - V @ S[certain.rows[:, None], rows]
    nu = nu - (V @ certain.mu).reshape(-1, 1, 3)
    seen = P_D[uncertain]
    candidates = candidates_of(inside[uncertain])
    log_lost = -np.inf
    if combinations(candidates) <= FEW:
        hypotheses = every_hypothesis(candidates)
    else:
        hypotheses, log_lost = grow_tree(candidates, S_uu, nu, seen, clutter, rules.pruned_mass)
    m = weigh(hypotheses, S_uu, nu, seen, clutter)
    lost = certain.lost + float(np.exp(min(log_lost - m.log_total, 0.0)))

    A, c = certain.A, len(certain.rows)
    n = c + len(rows)
    g, W = np.empty(n), np.empty((n, n))
    WV = m.W @ V
    g[:c], g[c:] = certain.g - V.T @ m.g, m.g
    W[:c, :c], W[c:, c:] = A + V.T @ WV, m.W
    W[c:, :c], W[:c, c:] = -WV, -WV.T
    detected = np.flatnonzero(m.best != MISSED)
    nis = np.concatenate(
        [distance[certain.pairs.targets, certain.pairs.detections], distance[uncertain[detected], m.best[detected]]]
    )
    return Association(np.concatenate([certain.rows, rows]), g, W, lost, nis)


def _nothing() -> Association:
    return Association(_NO_ROWS, np.zeros(0), np.zeros((0, 0)), 0.0, np.zeros(0))


_XYZ = np.arange(3)
_NO_ROWS = np.zeros(0, dtype=np.intp)
