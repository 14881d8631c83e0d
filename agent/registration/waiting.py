"""When has all come of a tick that will come? A set is not waited for that is lost, nor one of a MAV that is silent."""

import numpy as np

from agent.interface.frames import Array
from agent.registration.window import Frame

LOST_TICKS = 1  # after a newer set of the same MAV has come, one that has not is taken to be lost
SILENT_TICKS = 5  # after which a MAV of which something was heard is not waited for


class Waiting:
    """For what `mavs` MAVs send, at most for `lag` ticks."""

    def __init__(self, mavs: int, lag: int, tick: int) -> None:
        """From this tick on."""
        self._lag = lag
        self._arrived = np.full(mavs, tick, np.intp)  # the tick in which something of each last came in
        self._met = np.zeros(mavs, bool)  # of whom something ever has
        self._came: dict[tuple[int, int], int] = {}  # by tick and station (index): the tick in which a set came in

    def heard(self, now: int, mavs: list[int]) -> None:
        """Something of these (index) came in."""
        self._arrived[mavs] = now
        self._met[mavs] = True

    def heard_set(self, now: int, tick: int, station: int) -> None:
        self._came[tick, station] = now

    def silence(self, now: int) -> Array:
        """(N,) ticks for which nothing has been heard of each."""
        return (now - self._arrived + ~self._met).astype(np.float64)

    def over(self, frames: list[Frame]) -> int:
        """For how many of these, the oldest first and the newest that there is last, the waiting is over."""
        if not frames:
            return 0
        now, mavs = frames[-1].tick, len(self._met)
        silent = now - self._arrived >= np.where(self._met, SILENT_TICKS, self._lag)
        # By frame, whether a newer reading of each MAV is there, and for long enough a newer set.
        read, passed = np.zeros((2, len(frames), mavs), bool)
        for k in range(len(frames) - 2, -1, -1):
            later = frames[k + 1]
            read[k] = read[k + 1] | later.read
            passed[k] = passed[k + 1] | [now - self._came.get((later.tick, j), now) >= LOST_TICKS for j in range(mavs)]
        for k, frame in enumerate(frames):
            ready = (frame.heard | passed[k] | silent) & (frame.read | read[k] | silent)
            if not ready.all() and now - frame.tick < self._lag:
                return k
        return len(frames)

    def done(self, tick: int) -> None:
        """Nobody waits any more for this tick and those before."""
        self._came = {key: came for key, came in self._came.items() if key[0] > tick}
