"""Are those whom we call localised still who and where we think? What every MAV should see, and be seen by, says so.

A wrong identity, a VIO that has reset, a MAV that was carried off: its own detection sets, or those of the others at
its place, stop being explained. The two directions are counted apart, and the worst offender is taken out before the
next is judged, so that the others do not suffer for it.
"""

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array
from agent.registration.bank import Bank, Filter, Team
from agent.registration.window import Frame

EVERY, FEW = 3, 3  # ticks between looks; a team so small, which sees little in each, is looked at every tick
MEMORY = 0.9  # per look
FAR_LESS = 0.6  # of the share of sightings that the team on the whole explains: inconsistent ...
LEAST_USUAL = 0.75  # of P_D: what the team explains is not taken to be usual below
SURE = 16.0  # ... if the odds against so few by chance are e^16


class Watchdog:
    def __init__(self, sight: Filter, mavs: int, P_D: float) -> None:
        self._filter, self._P_D = sight, P_D
        self._expected = np.zeros((mavs, mavs))
        self._explained = np.zeros((mavs, mavs))

    def forget(self, mavs: list[int]) -> None:
        """Begins anew with these MAVs (indices)."""
        for counts in (self._expected, self._explained):
            counts[mavs] = 0.0
            counts[:, mavs] = 0.0

    def look(self, team: Team, frame: Frame) -> list[int]:
        """Indices of the MAVs that are inconsistent with the rest of the team; 0 means the station itself."""
        if len(self._expected) > FEW and frame.tick % EVERY:
            return []
        bank = Bank(team.y[None], team.P[None], team.placed[None])
        expected, explained = self._filter.explained(bank, frame)
        self._expected = MEMORY * self._expected + (expected > 0)
        self._explained = MEMORY * self._explained + explained
        left, bad = team.placed.copy(), []
        while (worst := self._worst(left)) is not None:
            bad.append(worst)
            left[worst] = False
        return bad

    def _worst(self, members: npt.NDArray[np.bool_]) -> int | None:
        if members.sum() < 2:
            return None
        both = members[:, None] & members
        expected, explained = np.where(both, self._expected, 0.0), np.where(both, self._explained, 0.0)
        counts = np.stack([expected.sum(0), expected.sum(1)])
        shares = np.stack([explained.sum(0), explained.sum(1)]) / np.maximum(counts, 1e-9)
        heard = members & (counts > 0)
        if not heard.any():
            return None
        usual = float(np.clip(np.median(shares[heard]), LEAST_USUAL * self._P_D, self._P_D))
        # Chernoff's bound on the chance of so few: counts are small at first
        chance = counts * (_relative(shares, usual) + _relative(1 - shares, 1 - usual))
        wrong = heard & (shares < FAR_LESS * usual) & (chance > SURE)
        if not wrong.any():
            return None
        worst = np.where(wrong, shares, np.inf).min(0)
        return int(np.flatnonzero(worst == worst.min())[-1])  # of two alike, not the station


def _relative(share: Array, usual: float) -> Array:
    """A term of the Kullback-Leibler divergence of two shares."""
    return np.asarray(share * np.log(np.maximum(share, 1e-12) / usual))
