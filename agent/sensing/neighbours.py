"""What have the MAVs said, tick by tick? Odometry and detection sets, kept until their tick is estimated."""

from dataclasses import dataclass, field

from agent.interface.frames import Array

AHEAD = 64  # ticks that may wait; a sender further ahead of everybody is not believed


@dataclass
class Tick:
    odometry: dict[int, Array] = field(default_factory=dict)  # by MAV: (4,) x y z m, yaw rad
    detections: dict[int, Array] = field(default_factory=dict)  # by MAV: (M, 3) spherical, levelled


class Neighbours:
    """Own data is put here as well: an agent treats itself as one of the team."""

    def __init__(self, mavs: int) -> None:
        self._mavs = mavs
        self._ticks: dict[int, Tick] = {}
        self._done_ns = -1  # stamp of the last tick taken
        self.late = 0
        self.duplicate = 0

    def put(self, stamp_ns: int, mav: int, *, odometry: Array | None = None, detections: Array | None = None) -> bool:
        """Keeps one reading or set, unless its tick is over; that is counted late, a repetition duplicate."""
        if stamp_ns <= self._done_ns:
            self.late += 1
            return False
        tick = self._ticks.get(stamp_ns)
        if tick is None:
            tick = self._ticks[stamp_ns] = Tick()
            if len(self._ticks) > AHEAD:
                del self._ticks[max(self._ticks)]
        for kept, new in ((tick.odometry, odometry), (tick.detections, detections)):
            if new is None:
                continue
            if mav in kept:
                self.duplicate += 1
            else:
                kept[mav] = new
        return True

    def complete(self, stamp_ns: int) -> bool:
        """Whether every MAV's odometry and detection set of this tick is here."""
        tick = self._ticks.get(stamp_ns)
        return tick is not None and len(tick.odometry) == self._mavs == len(tick.detections)

    def take(self, stamp_ns: int) -> Tick:
        """What there is for this tick; it and all before it are over."""
        tick = self._ticks.get(stamp_ns, Tick())
        self._ticks = {stamp: kept for stamp, kept in self._ticks.items() if stamp > stamp_ns}
        self._done_ns = stamp_ns
        return tick
