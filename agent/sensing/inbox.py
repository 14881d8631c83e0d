"""Which packets may an agent believe? Decodes, checks and counts; nothing that arrives can do more harm than that."""

import logging
from dataclasses import dataclass, field
from typing import NamedTuple

from agent.interface import messages, topics
from agent.interface.bus import Packet
from agent.sensing.own_time import JUMP_S, OwnTime

OWN = "sensor"
LOGGED = 1000  # keys and reasons
AT_ONCE = 256  # packets of one sender that are looked at between two ticks: as many as a link that heals may bring

log = logging.getLogger(__name__)


class Received(NamedTuple):
    topic: topics.Topic
    mav: int  # whose key it came on
    message: messages.Header


@dataclass
class Inbox:
    """The boundary of one agent: `read` returns valid messages of this run only, and keeps count."""

    mav: int
    mavs: int
    epoch: int
    received: int = 0
    rejected: int = 0
    _logged: set[tuple[str, str]] = field(default_factory=set)
    _counts: dict[str, int] = field(default_factory=dict)  # since the last tick, by sender

    def __post_init__(self) -> None:
        self._own_time = OwnTime()

    def next_tick(self) -> None:
        """Every sender may say something again."""
        self._counts.clear()

    def read(self, packet: Packet) -> Received | None:
        """The message in a packet, or None if it is not one; the first reason per key is logged."""
        self.received += 1
        try:
            self._count(_source(packet.key))
            return self._checked(packet)
        except messages.Rejected as error:
            self.rejected += 1
            if (packet.key, error.reason) not in self._logged and len(self._logged) < LOGGED:
                self._logged.add((packet.key, error.reason))
                log.warning("ignored a message on %.80r: %s (more of these are only counted)", packet.key, error)
            return None

    def _count(self, source: str) -> None:
        """Its own sensors are not limited, for rubbish at their keys must not make it blind; the bus's queue is."""
        count = self._counts[source] = self._counts.get(source, 0) + 1
        if source != OWN and count > AT_ONCE:
            raise messages.Rejected("flood", f"more than {AT_ONCE} of one sender in a tick")

    def _checked(self, packet: Packet) -> Received:
        topic, mav = topics.parse(packet.key)
        header, sender = messages.header(packet.payload, self.epoch), mav if topic.key.startswith("air/") else 0
        if header.sender != sender or not 1 <= mav <= self.mavs:
            raise messages.Rejected("sender", f"{header.sender} on the key of MAV {mav} of {self.mavs}")
        message = messages.decode(topic.kind, packet.payload, self.epoch)
        if isinstance(message, messages.Survey) and len(message.poses) != 32 * self.mavs:
            raise messages.Rejected("malformed", f"a survey of {len(message.poses) // 32} MAVs, expected {self.mavs}")
        if topic in (topics.VIO, topics.SIGHTINGS) and not self._own_time.believes(header.stamp_ns):
            raise messages.Rejected("clock", f"{header.stamp_ns} ns, more than {JUMP_S:g} s after all before")
        return Received(topic, mav, message)


def _source(key: str) -> str:
    """Whose limit a packet counts for: a MAV's, or its own sensors'. All that is of no MAV counts together."""
    kind, _, rest = key.partition("/")
    if kind == OWN:
        return OWN
    mav = rest.partition("/")[0]
    return mav if len(mav) <= 3 and mav.isascii() and mav.isdecimal() else "?"
