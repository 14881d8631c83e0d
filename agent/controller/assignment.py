"""Who goes where? Every agent decides it for all from its own estimate, and goes by what the others have claimed.

The least sum of squared distances keeps straight ways of equal duration from crossing: if start and goal places are
2 sqrt(2) R apart, MAVs of radius R do not touch (Turpin, Michael and Kumar 2014, "CAPT: Concurrent assignment and
planning of trajectories for multiple robots").
"""

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from agent.interface.frames import Array

Mask = npt.NDArray[np.bool_]

BETTER_M2 = 0.2  # by which the sum of squares must be less for a claim to be changed
BLOCKED_M2 = 1e6  # what a place counts at which somebody hangs who does not fly any more
EQUAL_M2 = 1e-3  # sums of squares that differ by less are equal: then lower numbers take lower places


def assigned(positions: Array, places: Array, blocked: Mask) -> npt.NDArray[np.intp]:
    """(n,) the place of each of n MAVs at positions (n, 3) among N >= n places (N, 3), m, in one frame; a blocked one
    (N,) only if there are too few others."""
    squared = _squared(positions, places, blocked)
    n, N = squared.shape
    rank = np.arange(n)[:, None] * np.arange(N)
    tie = -EQUAL_M2 * rank / max(n * N, 1) / n  # the products of an ascending pairing sum to most
    return np.asarray(linear_sum_assignment(np.round(squared / EQUAL_M2) * EQUAL_M2 + tie)[1])


def kept(positions: Array, places: Array, blocked: Mask, own: int, before: int) -> bool:
    """Whether MAV `own` (of the rows) may keep to the place that it has claimed before: another would hardly be better.

    Estimates are noisy: without that, equals would change places for ever.
    """
    others = np.delete(positions, own, axis=0), np.delete(places, before, axis=0), np.delete(blocked, before)
    with_it = _total(*others) + float(_squared(positions, places, blocked)[own, before])
    return with_it < _total(positions, places, blocked) + BETTER_M2


def _squared(positions: Array, places: Array, blocked: Mask) -> Array:
    """(n, N) m^2"""
    return np.asarray(((positions[:, None] - places[None]) ** 2).sum(-1) + BLOCKED_M2 * blocked)


def _total(positions: Array, places: Array, blocked: Mask) -> float:
    rows = np.arange(len(positions))
    return float(_squared(positions, places, blocked)[rows, assigned(positions, places, blocked)].sum())


def claimed(wanted: int, distances: Array, claims: dict[int, int], mav: int) -> int:
    """The place that MAV `mav` claims, given the places that others have claimed (by MAV).

    Where estimates differ so much that two want one place, the lower number has it, and the other takes the nearest
    that no lower number claims. So the claims of 1, 2, ... settle in turn.

    Args:
        wanted: the place by its own assignment.
        distances: (N,) m from it to every place.
    """
    taken = {place for other, place in claims.items() if other < mav}
    if wanted not in taken:
        return wanted
    return min(set(range(len(distances))) - taken, key=lambda place: (float(distances[place]), place))
