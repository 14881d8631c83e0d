"""How can one inbox be several, so that who floods one loses only what is his?"""

import math

from agent.interface import clock
from agent.interface.bus import POLL_S, Inbox, Packet


class SeveralInboxes:
    """One inbox made of several, each with a queue of its own, which it asks in turn."""

    def __init__(self, inboxes: list[Inbox], poll_s: float = POLL_S) -> None:
        self._inboxes, self._poll_s = inboxes, poll_s

    def drain(self) -> list[Packet]:
        return [packet for inbox in self._inboxes for packet in inbox.drain()]

    def wait(self, timeout_s: float | None) -> list[Packet]:
        deadline = math.inf if timeout_s is None else clock.now_s() + timeout_s
        while not (packets := self.drain()) and clock.now_s() < deadline:
            clock.sleep_until(clock.now_s() + self._poll_s)
        return packets
