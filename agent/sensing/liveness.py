"""Is a neighbour still there? From the tokens that vanish with a process, and the age of what it has said last."""

import logging
from collections.abc import Callable

from agent.interface.messages import ALIVE, GONE, NEIGHBOURS, STALE

log = logging.getLogger("agent")


class Liveness:
    """Of the neighbours of one agent; ages are in the time of its own sensors."""

    def __init__(self, mav: int, mavs: int, stale_after_s: float, gone_after_s: float) -> None:
        self._mav, self._stale_after_ns, self._gone_after_ns = mav, stale_after_s * 1e9, gone_after_s * 1e9
        self._heard_ns: dict[int, int] = {}  # stamp of the newest odometry of each
        self.states = [ALIVE] * mavs

    def heard(self, mav: int, stamp_ns: int) -> None:
        self._heard_ns[mav] = max(stamp_ns, self._heard_ns.get(mav, stamp_ns))

    def look(self, now_ns: int, has_token: Callable[[int], bool] | None) -> None:
        """Decides anew, and logs what has changed.

        Args:
            has_token: whether the process of a MAV has a token; None if nobody has any, as inside one process.
        """
        for index, before in enumerate(self.states):
            mav = index + 1
            if mav == self._mav:
                continue
            # Nothing can have been heard after now; who was never heard counts from the first look on.
            heard_ns = self._heard_ns[mav] = min(self._heard_ns.get(mav, now_ns), now_ns)
            age_ns = now_ns - heard_ns
            if age_ns > self._gone_after_ns or not (has_token is None or has_token(mav)):
                state = GONE
            else:
                state = STALE if age_ns > self._stale_after_ns else ALIVE
            if state != before:
                self.states[index] = state
                log.info(
                    "MAV %d is %s at %.1f s (last heard at %.1f s)",
                    mav,
                    NEIGHBOURS[state],
                    now_ns / 1e9,
                    heard_ns / 1e9,
                )
