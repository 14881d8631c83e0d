"""How do messages travel? A bus, and the one within a process; the one over Zenoh is in `zenoh_bus.py`.

A program publishes to keys and pulls from inboxes; no callback ever runs in it. Lossless (lockstep): nothing is
dropped, a full queue makes the publisher wait. Not lossless (real time): a slow receiver loses the oldest messages
and never holds up a publisher.
"""

from collections import deque
from typing import NamedTuple, Protocol

CAPACITY = 4096  # packets an inbox holds, unless it is asked for less
POLL_S = 0.0005


class Packet(NamedTuple):
    key: str
    payload: bytes


class Inbox(Protocol):
    def drain(self) -> list[Packet]:
        """What has arrived, oldest first; empty if nothing has."""

    def wait(self, timeout_s: float | None) -> list[Packet]:
        """The same, but waits for the first packet: for ever (None) or up to a limit.

        Empty after a wait without a limit: nothing more will come before the receiver goes on.
        """


class Bus(Protocol):
    def publish(self, key: str, payload: bytes) -> None: ...

    def subscribe(self, pattern: str, capacity: int = CAPACITY) -> Inbox:
        """An inbox for keys that match; in the pattern * stands for one chunk and a final ** for any number.

        Args:
            capacity: how many packets it holds, if the bus is not lossless.
        """


class BusError(Exception):
    """The network could not be opened, or a process that was waited for did not come."""


class MemoryBus:
    """Programs of one process, each with a bus of its own on one network.

    Delivery is immediate and in order; as with Zenoh, a program does not hear itself.
    """

    def __init__(self, network: "_MemoryNetwork | None" = None) -> None:
        self._network = _MemoryNetwork() if network is None else network
        self._own: list[MemoryInbox] = []
        self._routes: dict[str, list[MemoryInbox]] = {}
        self._routed = 0  # which state of the network the routes are of

    def another(self) -> "MemoryBus":
        """The bus of one more program on the same network."""
        return MemoryBus(self._network)

    def publish(self, key: str, payload: bytes) -> None:
        if self._routed != self._network.changes:
            self._routes, self._routed = {}, self._network.changes
        inboxes = self._routes.get(key)
        if inboxes is None:
            inboxes = self._routes[key] = [
                inbox for pattern, inbox in self._network.inboxes if inbox not in self._own and _matches(pattern, key)
            ]
        for inbox in inboxes:
            inbox.packets.append(Packet(key, payload))

    def subscribe(self, pattern: str, capacity: int = CAPACITY) -> "MemoryInbox":
        inbox = MemoryInbox()
        self._own.append(inbox)
        self._network.inboxes.append((pattern, inbox))
        self._network.changes += 1
        return inbox

    def close(self) -> None:
        """Nothing reaches its inboxes any more."""
        self._network.inboxes = [(pattern, inbox) for pattern, inbox in self._network.inboxes if inbox not in self._own]
        self._network.changes += 1


class _MemoryNetwork:
    def __init__(self) -> None:
        self.inboxes: list[tuple[str, MemoryInbox]] = []  # with their patterns
        self.changes = 0  # so many inboxes have come and gone


class MemoryInbox:
    def __init__(self) -> None:
        self.packets: deque[Packet] = deque()

    def drain(self) -> list[Packet]:
        packets = list(self.packets)
        self.packets.clear()
        return packets

    def wait(self, timeout_s: float | None) -> list[Packet]:
        return self.drain()


def _matches(pattern: str, key: str) -> bool:
    expected, chunks = pattern.split("/"), key.split("/")
    if expected[-1] == "**":
        expected = expected[:-1]
        chunks = chunks[: len(expected)] if len(chunks) >= len(expected) else chunks
    return len(expected) == len(chunks) and all(
        want in ("*", chunk) for want, chunk in zip(expected, chunks, strict=True)
    )
