"""What is on its way to one MAV, and what has reached it? All the links to it, and their journal."""

import heapq
from array import array
from typing import NamedTuple

from agent.interface import messages
from agent.interface.bus import CAPACITY, Packet
from agent.interface.fleet import Fleet
from deploy.faults import Faults
from deploy.link_model import LinkModel


class Sent(NamedTuple):
    """A packet that a peer has sent; these sort as they are to be sent on."""

    stamp_ns: int  # of its content
    sender: int
    topic: int  # index into messages.AIR
    packet: Packet


class _Due(NamedTuple):
    arrives_ns: int
    sent: Sent
    number: int  # of the packets so far: nothing that comes after it in the tuple is ever compared


class InFlight:
    def __init__(self, faults: Faults, fleet: Fleet, receiver: int, incarnation: int) -> None:
        """Links to the MAV `receiver`, which has been started anew so many times."""
        self._links = {
            sender: LinkModel(faults, fleet, sender, receiver, incarnation)
            for sender in fleet.ids
            if sender != receiver
        }
        self._due: list[_Due] = []  # a heap
        self._number = 0
        self._arrived: list[Sent] = []  # since the last entry in the journal
        self._dropped = dict.fromkeys(fleet.ids, 0)

    def send(self, sent: Sent, now_ns: int) -> None:
        """A packet enters its link now."""
        arrivals_ns = self._links[sent.sender].arrivals_ns(now_ns, messages.AIR[sent.topic], len(sent.packet.payload))
        if not arrivals_ns or len(self._due) + len(arrivals_ns) > CAPACITY:
            self._dropped[sent.sender] += 1
            return
        for arrives_ns in arrivals_ns:
            self._number += 1
            heapq.heappush(self._due, _Due(arrives_ns, sent, self._number))

    def arrived(self, now_ns: int) -> list[Packet]:
        """What arrives by now, in the order in which it does; what arrives at once, by time, sender and topic."""
        packets = []
        while self._due and self._due[0].arrives_ns <= now_ns:
            sent = heapq.heappop(self._due).sent
            packets.append(sent.packet)
            if len(self._arrived) < CAPACITY:
                self._arrived.append(sent)
        return packets

    @property
    def next_ns(self) -> int | None:
        """When something arrives again; None: nothing is on its way."""
        return self._due[0].arrives_ns if self._due else None

    def journal(self, header: tuple[int, int, int, int, int]) -> messages.Arrivals:
        """What has arrived and was dropped since the last time."""
        arrived, dropped = self._arrived, self._dropped
        self._arrived, self._dropped = [], dict.fromkeys(dropped, 0)
        return messages.Arrivals(
            *header,
            senders=bytes(sent.sender for sent in arrived),
            topics=bytes(sent.topic for sent in arrived),
            stamps=array("q", (sent.stamp_ns for sent in arrived)).tobytes(),
            dropped=tuple(dropped.values()),
        )
