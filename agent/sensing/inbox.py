"""Which packets may an agent believe? Decodes, checks and counts; nothing that arrives can do more harm than that."""

import logging
from dataclasses import dataclass, field
from typing import NamedTuple

from agent.interface import messages, topics
from agent.interface.bus import Packet

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

    def read(self, packet: Packet) -> Received | None:
        """The message in a packet, or None if it is not one; the first reason per key is logged."""
        self.received += 1
        try:
            return self._checked(packet)
        except messages.Rejected as error:
            self.rejected += 1
            if (packet.key, error.reason) not in self._logged and len(self._logged) < 1000:
                self._logged.add((packet.key, error.reason))
                log.warning("ignored a message on %s: %s (more of these are only counted)", packet.key, error)
            return None

    def _checked(self, packet: Packet) -> Received:
        topic, mav = topics.parse(packet.key)
        message = messages.decode(topic.kind, packet.payload, self.epoch)
        sender = mav if topic.key.startswith("air/") else 0
        if message.sender != sender or not 1 <= mav <= self.mavs:
            raise messages.Rejected("sender", f"{message.sender} on the key of MAV {mav} of {self.mavs}")
        if isinstance(message, messages.Survey) and len(message.poses) != 32 * self.mavs:
            raise messages.Rejected("malformed", f"a survey of {len(message.poses) // 32} MAVs, expected {self.mavs}")
        return Received(topic, mav, message)
