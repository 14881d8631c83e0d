"""What do the own sensors say, tick by tick? VIO readings and detection sets, until both of a time are here."""

import math
from typing import NamedTuple, TypeVar

from agent.interface.messages import Sightings
from agent.sensing.vio import Levelled

T = TypeVar("T")
WAITING = 1024  # readings and sets that may wait for one another: the oldest go


class Reading(NamedTuple):
    stamp_ns: int
    levelled: Levelled
    sightings: Sightings


class OwnSensors:
    def __init__(self) -> None:
        self._vio: dict[int, Levelled] = {}  # by stamp
        self._sightings: dict[int, Sightings] = {}
        self._begun_ns = -1  # stamp of the newest pair that was taken

    def put_vio(self, stamp_ns: int, levelled: Levelled) -> None:
        self._put(self._vio, stamp_ns, levelled)

    def put_sightings(self, message: Sightings) -> None:
        self._put(self._sightings, message.stamp_ns, message)

    def _put(self, kept: dict[int, T], stamp_ns: int, new: T) -> None:
        if stamp_ns > self._begun_ns:
            kept.setdefault(stamp_ns, new)
        if len(kept) > WAITING:
            del kept[min(kept)]

    def take(self, behind: float = math.inf) -> Reading | None:
        """The oldest pair, or the newest if more than `behind` newer ones wait; what is older than it is over."""
        pairs = self._vio.keys() & self._sightings.keys()
        if not pairs:
            return None
        stamp_ns = min(pairs) if len(pairs) <= behind + 1 else max(pairs)
        reading = Reading(stamp_ns, self._vio[stamp_ns], self._sightings[stamp_ns])
        self._vio = {stamp: kept for stamp, kept in self._vio.items() if stamp > stamp_ns}
        self._sightings = {stamp: kept for stamp, kept in self._sightings.items() if stamp > stamp_ns}
        self._begun_ns = stamp_ns
        return reading
