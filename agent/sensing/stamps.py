"""Which time stamps may an agent believe? Clocks jump, and peers may say what they like."""

from dataclasses import dataclass

AHEAD_TICKS = 50  # of its own newest reading, that a peer may be: fewer than wait in `neighbours.py`
JUMP_S = 60.0  # by which its own sensors may go on at once, as after a pause ...
CONFIRMED = 10  # ... or further, if so many in a row agree, of different times
STEP_S = 1.0  # these are so close to one another


@dataclass
class Stamps:
    """The time of one agent, as its own sensors tell it. Everybody measures on the grid of the fleet's rate."""

    rate_hz: float
    _newest_ns: int = 0  # of its own sensors
    _known: bool = False  # whether they have said anything yet: before, any time is as good as another
    _doubtful_ns: int = 0
    _doubts: int = 0

    def own(self, stamp_ns: int) -> str:
        """Why a reading of its own sensors cannot be of this time; "" if it can."""
        if not self._on_grid(stamp_ns):
            return f"own stamp {stamp_ns} ns: not a tick of {self.rate_hz:g} Hz"
        if stamp_ns - self._newest_ns > JUMP_S * 1e9 and not self._confirmed(stamp_ns):
            return f"own stamp {stamp_ns} ns: more than {JUMP_S:g} s after {self._newest_ns} ns"
        self._newest_ns = self._doubtful_ns = max(stamp_ns, self._newest_ns)
        self._known = True
        self._doubts = 0
        return ""

    def peers(self, stamp_ns: int) -> str:
        """Why a peer's message cannot be of this time; "" if it can. That it is late is not for here."""
        if not self._on_grid(stamp_ns):
            return f"stamp {stamp_ns} ns: not a tick of {self.rate_hz:g} Hz"
        if self._known and self._tick(stamp_ns) - self._tick(self._newest_ns) > AHEAD_TICKS:
            return f"stamp {stamp_ns} ns: more than {AHEAD_TICKS} ticks after {self._newest_ns} ns"
        return ""

    def _tick(self, stamp_ns: int) -> int:
        return round(stamp_ns * self.rate_hz / 1e9)

    def _on_grid(self, stamp_ns: int) -> bool:
        return stamp_ns >= 0 and stamp_ns == round(self._tick(stamp_ns) * 1e9 / self.rate_hz)

    def _confirmed(self, stamp_ns: int) -> bool:
        if stamp_ns != self._doubtful_ns:
            self._doubts = self._doubts + 1 if 0 < stamp_ns - self._doubtful_ns <= STEP_S * 1e9 else 1
            self._doubtful_ns = stamp_ns
        return self._doubts >= CONFIRMED
