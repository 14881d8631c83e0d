"""Which joint hypotheses are carried, and how have they done? A bank with the record of each."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array, relative_pose, wrap
from agent.registration.bank import Bank, Explained

WINDOW = 40  # ticks over which evidence is summed
MEMORY = 0.95  # per tick: of how well detections are explained
MARGIN, PER_SIGMA, LEAST_SIGMA = 12.0, 6.0, 3.0  # nats, and standard deviations of the ratio's random walk
UNTOLD = 5.0  # nats: a tick with fewer tells two hypotheses apart by chance only
HOPELESS = 3.0  # margins
SAME_M, SAME_RAD = 0.3, 0.12  # two poses relative to the station within these are one place
Mask = npt.NDArray[np.bool_]


@dataclass
class Hypotheses:
    """K of them, in no order."""

    bank: Bank
    names: npt.NDArray[np.intp]  # (K,) a number of its own for each, for as long as it lives
    evidence: Array  # (K, WINDOW) nats a tick, the newest last; NaN before the hypothesis began
    track: Array  # (K, WINDOW, N, 4) the poses it believed in then
    expected: Array  # (K, N, N) how often a station (row) might have seen a target (column), fading
    explained: Array  # (K, N, N) how often it has
    square: Array  # (K,) sum of normalised squared residuals, fading
    events: Array  # (K,) of how many detections

    @staticmethod
    def fresh(bank: Bank, names: Sequence[int]) -> "Hypotheses":
        K, N = bank.placed.shape
        zeros = np.zeros((K, N, N))
        evidence, track = np.full((K, WINDOW), np.nan), np.full((K, WINDOW, N, 4), np.nan)
        return Hypotheses(
            bank, np.array(names, np.intp), evidence, track, zeros, zeros.copy(), np.zeros(K), np.zeros(K)
        )

    def __len__(self) -> int:
        return len(self.names)

    def note(self, tick: Explained, burn_in: bool = False) -> None:
        """Adds one tick to the record; in its first a hypothesis earns no evidence, having been made from it."""
        self.evidence = np.roll(self.evidence, -1, axis=1)
        self.evidence[:, -1] = np.nan if burn_in else tick.evidence
        self.track = np.roll(self.track, -1, axis=1)
        self.track[:, -1] = self.bank.y[:, :-1]
        self.expected = MEMORY * self.expected + (tick.expected > 0)
        self.explained = MEMORY * self.explained + tick.explained
        self.square = MEMORY * self.square + tick.square
        self.events = MEMORY * self.events + tick.events

    def of(self, which: list[int]) -> "Hypotheses":
        parts: Any = [getattr(self, part)[which] for part in _PARTS]
        return Hypotheses(self.bank.of(which), *parts)

    def joined(self, other: "Hypotheses") -> "Hypotheses":
        """Both; what is in both is kept with the longer record."""
        both: Any = [np.concatenate([getattr(self, part), getattr(other, part)]) for part in _PARTS]
        return Hypotheses(self.bank.joined(other.bank), *both).merged()

    def merged(self) -> "Hypotheses":
        """Without duplicates: of several that place everybody alike, the one with the longest record stays."""
        length = np.isfinite(self.evidence).sum(1)
        elsewhere = self.elsewhere()
        kept: list[int] = []
        for k in np.lexsort((-self.recent(), -length)):
            if all(elsewhere[k, other].any() for other in kept):
                kept.append(int(k))
        return self if len(kept) == len(self) else self.of(sorted(kept))

    def against(self, poses: Array, placed: Mask) -> Mask:
        """(K,) who disagrees with these poses (N, 4), in the station's odometry frame, of the MAVs placed (N,)."""
        differs = elsewhere(from_station(poses[None]), placed[None], self.relative(), self.bank.placed)
        return np.asarray((differs & placed).any(axis=1))

    @property
    def ticks(self) -> int:
        """For which all of them have evidence."""
        return int(np.isfinite(self.evidence).all(axis=0).sum())

    def earned(self, which: int, ticks: int, ago: int) -> float:
        """Nats of one in the `ticks` that ended so long ago; -inf where its record does not reach back."""
        if ticks + ago > WINDOW:
            return -np.inf
        part = self.evidence[which, WINDOW - ago - ticks : WINDOW - ago]
        return float(part.sum()) if np.isfinite(part).all() else -np.inf

    def spread(self, ticks: int) -> float:
        """Nats between the best and the worst in so many last ticks; those that began later aside."""
        earned = self.evidence[:, -ticks:].sum(1)
        earned = earned[np.isfinite(earned)]
        return float(np.ptp(earned)) if len(earned) else 0.0

    def worth(self, most: int, missing: Mask) -> list[int]:
        """Whom to keep: the leader, for every MAV in question (N,) the best that places it elsewhere, the best of the
        rest. Dropped by score alone, those left might by chance agree on some MAV."""
        order = [int(k) for k in np.argsort(-self.recent(), kind="stable")]
        different = self.elsewhere()[order[0]]
        kept = order[:1]
        for j in np.flatnonzero(missing):
            best = next((k for k in order if different[k, j]), None)
            if best is not None and best not in kept:
                kept.append(best)
        kept += [k for k in order if k not in kept]
        return sorted(kept[:most])

    def without_hopeless(self, best: float = -np.inf) -> "Hypotheses":
        """Without those that are so far behind the best, or behind `best` nats, that they will not come back."""
        score = self.recent()
        limit = HOPELESS * (MARGIN + PER_SIGMA * LEAST_SIGMA * np.sqrt(self.ticks))
        kept = [int(k) for k in np.flatnonzero(score > max(score.max(), best) - limit)]
        return self if len(kept) == len(self) else self.of(kept)

    def relative(self) -> Array:
        """(K, N, 4) poses in the station's body frame."""
        return from_station(self.bank.y[:, :-1])

    def elsewhere(self) -> npt.NDArray[np.bool_]:
        """(K, K, N) whether two hypotheses disagree where a MAV is, or whether that can be said."""
        relative = self.relative()
        return elsewhere(relative[:, None], self.bank.placed[:, None], relative[None], self.bank.placed[None])

    def recent(self) -> Array:
        """(K,) nats over the ticks that all hypotheses have in common."""
        common = np.isfinite(self.evidence).all(axis=0)
        return np.asarray(self.evidence[:, common].sum(1))

    def lead(self, leader: int) -> "Lead":
        """Of the leader over every hypothesis, in the ticks that the two have in common."""
        D = self.evidence[leader] - self.evidence
        return Lead(np.nansum(D, axis=1), np.array([_walk(each) for each in D]), np.isfinite(D).sum(1))


def _walk(D: Array) -> float:
    """Standard deviation of a sum of nats (T,) by chance.

    From the differences of successive ticks: their variance is that of the noise, whatever the trend. A tick in which
    what tells the two apart was not heard says nothing, of the noise neither.
    """
    telling = D[np.abs(D) > UNTOLD]  # NaN compares false
    n = len(telling)
    return float(np.sqrt((np.diff(telling) ** 2).sum() * n / (2 * (n - 1)))) if n > 1 else 0.0


_PARTS = ("names", "evidence", "track", "expected", "explained", "square", "events")  # by hypothesis, beside the bank


class Lead(NamedTuple):
    nats: Array  # (K,)
    walk: Array  # (K,) their standard deviation by chance
    ticks: npt.NDArray[np.intp]  # (K,)


def from_station(poses: Array) -> Array:
    """(K, N, 4) poses in the body frame of the first, the station."""
    return relative_pose(np.repeat(poses[:, :1], poses.shape[1], axis=1), poses)


def elsewhere(a: Array, a_placed: Mask, b: Array, b_placed: Mask) -> Mask:
    """Whether poses (..., N, 4) relative to the station are two places, or one of them is not known."""
    line = a[..., :3] - b[..., :3]
    apart = np.vecdot(line, line) > SAME_M**2
    turned = np.abs(wrap(a[..., 3] - b[..., 3])) > SAME_RAD
    return np.asarray(np.where(a_placed & b_placed, apart | turned, a_placed != b_placed))
