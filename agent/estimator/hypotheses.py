"""Which joint associations are worth weighing? (the paper, Sec. V-A step 3)

A hypothesis says, for every target, which detection is its own, or that it was missed; no detection belongs to two
targets. Innovations of different targets are correlated through the station, so likelihoods do not factor over
targets, and methods that assume they do (per-target JPDA, EHM) give another answer. Two generators:

- few combinations: all of them, from a cache keyed by the pattern of the gates;
- many: a tree grown target by target. Branches that detect the same targets share their conditional covariances
  (Schur complements), so a branch costs one 3-vector. Branches that fall behind the best are cut, and a bound on the
  mass that is lost with them is kept.
"""

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.estimator.small_matrices import inverses
from agent.interface.frames import Array

MISSED = -1
FEW = 512  # combinations up to which all are listed
MOST_BRANCHES = 4000
SLACK = 8.0  # nats by which a branch may fall behind for the time being
LOG_2PI_3_2 = 1.5 * np.log(2 * np.pi)

Assignments = npt.NDArray[np.intp]


class Hypotheses(NamedTuple):
    """H hypotheses over L targets, in G groups of rows that detect the same targets."""

    assigned: Assignments  # (H, L) detection of each target, or MISSED
    detected: npt.NDArray[np.bool_]  # (G, L) which targets each group detects
    starts: Assignments  # (G,) first row of each group
    counts: Assignments  # (G,) rows in each group
    both: Array  # (G, 3L, 3L) 1 where row and column belong to detected targets, else 0
    neither: Array  # (G, 3L) 1 on the diagonal of targets that are missed, else 0


class Tree(NamedTuple):
    hypotheses: Hypotheses
    log_lost: float  # log of a bound on the sum of the weights left out, in the units of `log_total` of weights.Weighed


def grouped(assigned: Assignments) -> Hypotheses:
    """Sorts hypotheses (H, L) into groups that detect the same targets."""
    assigned = assigned[np.lexsort((assigned != MISSED).T)] if assigned.shape[1] else assigned
    detected = assigned != MISSED
    starts = np.flatnonzero(np.r_[True, (detected[1:] != detected[:-1]).any(1)])
    mask = np.repeat(detected[starts], 3, axis=1).astype(float)
    counts = np.diff(np.r_[starts, len(assigned)])
    return Hypotheses(assigned, detected[starts], starts, counts, mask[:, :, None] * mask[:, None, :], 1 - mask)


def candidates_of(inside: npt.NDArray[np.bool_]) -> tuple[tuple[int, ...], ...]:
    """Per target the detections inside its gate."""
    return tuple(tuple(np.flatnonzero(row).tolist()) for row in inside)


def combinations(candidates: tuple[tuple[int, ...], ...]) -> int:
    """Upper bound on the number of hypotheses."""
    count = 1
    for own in candidates:
        count *= 1 + len(own)
    return count


@lru_cache(maxsize=512)
def every_hypothesis(candidates: tuple[tuple[int, ...], ...]) -> Hypotheses:
    """All hypotheses of this gate pattern."""
    rows = []
    for row in product(*((MISSED, *own) for own in candidates)):
        taken = [m for m in row if m != MISSED]
        if len(taken) == len(set(taken)):
            rows.append(row)
    return grouped(np.array(rows, dtype=np.intp).reshape(len(rows), len(candidates)))


class _Branches(NamedTuple):
    """The frontier of the tree: K branches, in G groups that detect the same targets."""

    assigned: Assignments  # (K, level)
    score: Array  # (K,) log weight so far
    used: npt.NDArray[np.bool_]  # (K, M)
    group: npt.NDArray[np.intp]  # (K,)
    shift: Array  # (K, 3 r) conditional mean of the innovations of the r targets that remain
    S: Array  # (G, 3 r, 3 r) their conditional covariance


def grow_tree(
    candidates: tuple[tuple[int, ...], ...], S: Array, innovations: Array, P_D: Array, clutter: float, pruned: float
) -> Tree:
    """The hypotheses whose weight is more than about `pruned` of the best one's.

    Args:
        candidates: per target.
        S: (3L, 3L) innovation covariance, m^2.
        innovations: (L, M, 3) m.
        P_D: (L,) detection probabilities.
        clutter: false detections per m^3.
        pruned: relative weight; 0 keeps all (up to MOST_BRANCHES).
    """
    order = sorted(range(len(candidates)), key=lambda t: len(candidates[t]))
    flat = (3 * np.array(order)[:, None] + np.arange(3)).ravel()
    gap = np.inf if pruned == 0 else SLACK - np.log(pruned)
    log_rest = _log_bound_of_rest(order, candidates, S, P_D, clutter)
    tree = _Branches(
        np.zeros((1, 0), dtype=np.intp),
        np.zeros(1),
        np.zeros((1, innovations.shape[1]), dtype=bool),
        np.zeros(1, dtype=np.intp),
        np.zeros((1, len(flat))),
        S[np.ix_(flat, flat)][None],
    )
    log_lost = -np.inf
    for level, target in enumerate(order):
        own = np.array(candidates[target], dtype=np.intp)
        tree = _branch(tree, own, innovations[target, own], P_D[target], clutter)
        keep = tree.score > tree.score.max() - gap
        if keep.sum() > MOST_BRANCHES:
            keep &= tree.score >= np.partition(tree.score, -MOST_BRANCHES)[-MOST_BRANCHES]
        if not keep.all():
            cut = tree.score[~keep]
            log_lost = np.logaddexp(log_lost, _log_sum(cut) + log_rest[level])
            groups, group = np.unique(tree.group[keep], return_inverse=True)
            tree = _Branches(
                tree.assigned[keep], tree.score[keep], tree.used[keep], group, tree.shift[keep], tree.S[groups]
            )
    assigned = np.empty_like(tree.assigned)
    assigned[:, order] = tree.assigned
    return Tree(grouped(assigned), float(log_lost))


def _branch(tree: _Branches, own: Assignments, innovations: Array, P_D: float, clutter: float) -> _Branches:
    """Every branch misses the next target, or detects it as one of its candidates that is still free."""
    missed = _Branches(
        np.column_stack([tree.assigned, np.full(len(tree.score), MISSED)]),
        tree.score + np.log1p(-P_D),
        tree.used,
        tree.group,
        tree.shift[:, 3:],
        tree.S[:, 3:, 3:],
    )
    if not len(own):
        return missed
    first = inverses(tree.S[:, :3, :3])
    gain = tree.S[:, 3:, :3] @ first.inverse
    conditional = tree.S[:, 3:, 3:] - gain @ tree.S[:, :3, 3:]
    nu = innovations[None] - tree.shift[:, None, :3]  # (K, candidates, 3)
    distance = ((nu @ first.inverse[tree.group]) * nu).sum(2)
    constant = np.log(P_D / clutter) - LOG_2PI_3_2 - 0.5 * np.log(first.determinant)
    score = (tree.score + constant[tree.group])[:, None] - 0.5 * distance
    branch, candidate = np.nonzero(~tree.used[:, own])
    group = tree.group[branch]
    used = tree.used[branch]
    used[np.arange(len(branch)), own[candidate]] = True
    shift = missed.shift[branch] + (gain[group] @ nu[branch, candidate][:, :, None])[:, :, 0]
    return _Branches(
        np.vstack([missed.assigned, np.column_stack([tree.assigned[branch], own[candidate]])]),
        np.concatenate([missed.score, score[branch, candidate]]),
        np.vstack([missed.used, used]),
        np.concatenate([missed.group, group + len(tree.S)]),
        np.vstack([missed.shift, shift]),
        np.concatenate([missed.S, conditional]),
    )


def _log_bound_of_rest(
    order: list[int], candidates: tuple[tuple[int, ...], ...], S: Array, P_D: Array, clutter: float
) -> Array:
    """Per level, log of the most that a branch can still gain: no conditional density of target t can exceed
    (2 pi)^-1.5 |(S^-1)_tt|^1/2, its peak given all the others."""
    precision = np.linalg.inv(S)
    peaks = np.array([np.linalg.det(precision[3 * t : 3 * t + 3, 3 * t : 3 * t + 3]) for t in order])
    degree = np.array([len(candidates[t]) for t in order])
    most = (1 - P_D[order]) + degree * (P_D[order] / clutter) * np.exp(-LOG_2PI_3_2) * np.sqrt(peaks)
    return np.concatenate([np.cumsum(np.log(most)[::-1])[::-1][1:], [0.0]])


def _log_sum(logs: Array) -> float:
    top = logs.max()
    return float(top + np.log(np.exp(logs - top).sum()))
