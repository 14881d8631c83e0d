"""What have the MAVs said, tick by tick? Odometry and detection sets, until their tick is estimated, and who said what.

A tick that is over is remembered for as long as late data of it is of use, so that a repetition is known for one.
"""

from dataclasses import dataclass, field

from agent.interface.frames import Array
from agent.interface.intent import Intent

AHEAD = 64  # ticks that may wait; a sender further ahead is not believed
OFF_BEAT = 0.25  # of a tick that a stamp may be off the common beat


@dataclass
class Tick:
    odometry: dict[int, Array] = field(default_factory=dict)  # by MAV: (4,) x y z m, yaw rad
    detections: dict[int, Array] = field(default_factory=dict)  # by MAV: (M, 3) spherical, levelled
    intents: dict[int, Intent] = field(default_factory=dict)  # by MAV


class Neighbours:
    """Own data is put here as well: an agent treats itself as one of the team."""

    def __init__(self, mavs: int, rate_hz: float, lag: int) -> None:
        """For stamps on the beat of this rate; data of a tick is of use until `lag` ticks later."""
        self._mavs, self._rate_hz, self._lag = mavs, rate_hz, lag
        self._ticks: dict[int, Tick] = {}  # by number
        self._now: int | None = None  # the last tick that was taken
        self._newest: dict[int, tuple[int, int]] = {}  # by MAV: tick and sequence number of its newest odometry
        self._intents: dict[int, tuple[int, Intent]] = {}  # by MAV: tick and the newest of ticks that are over
        self.late = 0  # beyond the lag
        self.duplicate = 0
        self.unbelieved = 0  # off the beat, or too far ahead

    def tick_of(self, stamp_ns: int) -> int:
        """The number of the tick nearest to this time."""
        return round(stamp_ns * self._rate_hz / 1e9)

    def _on_beat(self, stamp_ns: int) -> bool:
        beat = stamp_ns * self._rate_hz / 1e9
        return abs(beat - round(beat)) <= OFF_BEAT

    def _believed(self, stamp_ns: int) -> bool:
        return self._on_beat(stamp_ns) and (self._now is None or self.tick_of(stamp_ns) <= self._now + AHEAD)

    def expects(self, stamp_ns: int) -> bool:
        """Whether this is the time of a tick that is not over."""
        return self._on_beat(stamp_ns) and (self._now is None or self.tick_of(stamp_ns) > self._now)

    def restarted(self, stamp_ns: int, mav: int, seq: int) -> bool:
        """Whether the odometry with this sequence number shows that its sender has begun to count anew."""
        tick, before = self._newest.get(mav, (-1, -1))
        if not self._believed(stamp_ns) or self.tick_of(stamp_ns) <= tick:
            return False
        self._newest[mav] = (self.tick_of(stamp_ns), seq)
        return seq <= before

    def put(
        self,
        stamp_ns: int,
        mav: int,
        *,
        odometry: Array | None = None,
        detections: Array | None = None,
        intent: Intent | None = None,
    ) -> int | None:
        """Keeps one reading (and what its MAV is about to do) or set; returns its tick if that is over and the data is
        new and of use, else None."""
        number = self.tick_of(stamp_ns)
        if not self._believed(stamp_ns):
            self.unbelieved += 1
            return None
        over = self._now is not None and number <= self._now
        if self._now is not None and number <= self._now - self._lag:
            self.late += 1
            return None
        if number not in self._ticks:
            self._ticks[number] = Tick()
            if len(self._ticks) > AHEAD + self._lag + 1:
                del self._ticks[max(self._ticks)]
        tick, new = self._ticks.get(number, Tick()), False  # it may be the one that was too many
        if intent is not None:
            tick.intents.setdefault(mav, intent)
            if over:
                self._heard_of(number, tick)
        for kept, data in ((tick.odometry, odometry), (tick.detections, detections)):
            if data is None:
                continue
            if mav in kept:
                self.duplicate += 1
            else:
                kept[mav], new = data, True
        return number if new and over else None

    def complete(self, tick: int) -> bool:
        """Whether every MAV's odometry and detection set of this tick is here."""
        kept = self._ticks.get(tick)
        return kept is not None and len(kept.odometry) == self._mavs == len(kept.detections)

    def go_on_at(self, stamp_ns: int) -> None:
        """What is before this time is over: the own sensors say how late it is, however far ahead that is."""
        if self._now is not None:
            self._over(max(self._now, self.tick_of(stamp_ns) - 1))

    def take(self, tick: int) -> Tick:
        """What there is for this tick; it and all before it are over."""
        self._over(tick)
        return self._ticks.setdefault(tick, Tick())

    def _over(self, tick: int) -> None:
        self._now = tick
        for number in sorted(each for each in self._ticks if each <= tick):
            self._heard_of(number, self._ticks[number])
        self._ticks = {number: kept for number, kept in self._ticks.items() if number > tick - self._lag}

    def intents(self) -> dict[int, Intent]:
        """By MAV: what each was last about to do, as far as ticks are over."""
        return {mav: intent for mav, (_, intent) in self._intents.items()}

    def _heard_of(self, number: int, tick: Tick) -> None:
        for mav, intent in tick.intents.items():
            if number >= self._intents.get(mav, (-1, intent))[0]:
                self._intents[mav] = (number, intent)
