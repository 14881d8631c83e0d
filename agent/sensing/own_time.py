"""Which time may an agent's own sensors tell? Clocks jump. (Peers' times are judged by it, in `neighbours.py`.)"""

from dataclasses import dataclass

JUMP_S = 60.0  # by which its own sensors may go on at once, as after a pause ...
CONFIRMED = 10  # ... or further, if so many in a row agree, of different times
STEP_S = 1.0  # these are so close to one another


@dataclass
class OwnTime:
    """What has passed by the stamps of its own sensors; the run begins at 0."""

    _newest_ns: int = 0
    _doubtful_ns: int = 0
    _doubts: int = 0

    def believes(self, stamp_ns: int) -> bool:
        """Whether a reading can be of this time, as far as it is ahead; that it is of the past is not for here."""
        if stamp_ns - self._newest_ns > JUMP_S * 1e9 and not self._confirmed(stamp_ns):
            return False
        self._newest_ns = self._doubtful_ns = max(stamp_ns, self._newest_ns)
        self._doubts = 0
        return True

    def _confirmed(self, stamp_ns: int) -> bool:
        if stamp_ns != self._doubtful_ns:
            self._doubts = self._doubts + 1 if 0 < stamp_ns - self._doubtful_ns <= STEP_S * 1e9 else 1
            self._doubtful_ns = stamp_ns
        return self._doubts >= CONFIRMED
