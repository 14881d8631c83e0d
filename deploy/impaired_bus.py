"""How do faults on the links come about? A bus around an agent's own that loses and delays what arrives from peers.

Only `air/**` is touched. In lockstep a packet that is delayed by d becomes visible at the first tick of the receiver
whose stamp is that of the packet plus d or later: the sensor readings, which pass through here, say which tick it is.
Nothing is shown before everything that can be visible in a tick is here, so the same seed gives the same estimates
however fast which process is. In real time the clock decides.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence

from agent.interface import clock, messages, topics
from agent.interface.bus import CAPACITY, Bus, Inbox, Packet
from agent.interface.fleet import Fleet
from deploy.faults import Faults
from deploy.in_flight import InFlight, Sent
from deploy.peek import Peek, peek

Newcomers = Sequence[tuple[int, int]]  # MAV and incarnation


class ImpairedBus:
    """The bus that an agent is given instead of its own."""

    def __init__(
        self,
        inner: Bus,
        faults: Faults,
        fleet: Fleet,
        mav: int,
        epoch: int,
        incarnation: int = 0,
        meet: Callable[[Newcomers], None] = lambda _: None,
    ) -> None:
        """
        Args:
            inner: the agent's own bus.
            incarnation: how often this MAV's process has been started anew.
            meet: returns when these MAVs hear what is published.
        """
        self._inner, self._fleet, self._epoch, self.mav, self._meet = inner, fleet, epoch, mav, meet
        self.in_flight = InFlight(faults, fleet, mav, incarnation)
        self.stamp_ns = -1  # of the tick that the agent is in
        self.tick_is_over = True
        self.tick_zero_s: float | None = None  # real time only: when tick 0 was, by the clock
        self.roll: dict[int, int] | None = None  # MAV -> incarnation; None: everybody, from the start
        self._estimate_key = topics.key(topics.ESTIMATE, mav)
        self._journal_key = topics.key(topics.ARRIVALS, mav)
        self._pages = 0
        self._senders = {
            topics.key(topic, sender): (sender, number)
            for number, topic in enumerate((topics.ODOMETRY, topics.DETECTIONS))
            for sender in fleet.ids
            if sender != mav
        }
        self._last_ns = fleet.stamp_ns(fleet.ticks)
        self._air: _LockstepAir | None = None

    def publish(self, key: str, payload: bytes) -> None:
        """Passes everything on; an estimate ends a tick, whose arrivals are then written down."""
        self._inner.publish(key, payload)
        if key == self._estimate_key and (header := self.header(payload)) is not None:
            self.tick_is_over = True
            page = (messages.VERSION, self._epoch, messages.DEPLOY, self._pages, header.stamp_ns)
            self._pages += 1
            self._inner.publish(self._journal_key, messages.encode(self.in_flight.journal(page)))

    def subscribe(self, pattern: str, capacity: int = CAPACITY) -> Inbox:
        inbox = self._inner.subscribe(pattern, capacity)
        if pattern.startswith("air/"):
            if self._fleet.realtime:
                return _RealtimeAir(self, inbox)
            self._air = _LockstepAir(self, inbox)
            return self._air
        if pattern.startswith("sensor/"):
            return (_RealtimeSensors if self._fleet.realtime else _LockstepSensors)(self, inbox)
        return inbox

    @property
    def all_shown(self) -> bool:
        """Whether nothing more will come in the tick that the agent is in (lockstep)."""
        return self._air is not None and self._air.shown_ns == self.stamp_ns and not self.tick_is_over

    def header(self, payload: bytes) -> Peek | None:
        """The header of a message of this run."""
        header = peek(payload)
        return header if header is not None and header.epoch == self._epoch else None

    def sent(self, packet: Packet) -> Sent | None:
        """What a peer has sent; None if it is nothing of the kind, and for the agent to reject."""
        sender, topic = self._senders.get(packet.key, (0, 0))
        header = self.header(packet.payload)
        if header is None or not sender or header.sender != sender or not 0 <= header.stamp_ns <= self._last_ns:
            return None
        return Sent(header.stamp_ns, sender, topic, packet)

    def is_roll(self, packet: Packet) -> bool:
        return packet.key == topics.key(topics.ROLL, self.mav)

    def call(self, packet: Packet) -> None:
        """Takes in who takes part from now on; returns when newcomers hear what is published."""
        try:
            roll = messages.decode(messages.Roll, packet.payload, self._epoch)
        except messages.Rejected:
            return
        before, self.roll = self.roll, dict(zip(roll.mavs, roll.incarnations, strict=True))
        if before is not None and self.mav in self.roll:
            others = ((mav, incarnation) for mav, incarnation in self.roll.items() if mav != self.mav)
            newcomers = [(mav, incarnation) for mav, incarnation in others if before.get(mav) != incarnation]
            if newcomers:
                self._meet(newcomers)

    @property
    def peers(self) -> Iterable[int]:
        """Who else takes part."""
        return (mav for mav in (self._fleet.ids if self.roll is None else self.roll) if mav != self.mav)


class _LockstepSensors:
    """Gives the agent the readings of one tick at a time, also when it has been stopped and many have come together:
    what it does then must not depend on how many have."""

    def __init__(self, bus: ImpairedBus, inbox: Inbox) -> None:
        self._bus, self._inbox = bus, inbox
        self._readings = (topics.key(topics.VIO, bus.mav), topics.key(topics.SIGHTINGS, bus.mav))
        self._waiting: deque[Packet] = deque()

    def drain(self) -> list[Packet]:
        self._waiting.extend(self._inbox.drain())
        return self._of_this_tick()

    def wait(self, timeout_s: float | None) -> list[Packet]:
        while not (packets := self.drain()):
            more = self._inbox.wait(timeout_s)
            if not more:
                return []
            self._waiting.extend(more)
        return packets

    def _of_this_tick(self) -> list[Packet]:
        bus, packets = self._bus, list[Packet]()
        while self._waiting:
            packet = self._waiting[0]
            if bus.is_roll(packet):
                if not bus.tick_is_over:
                    break
                bus.call(self._waiting.popleft())
                continue
            if packet.key in self._readings and (header := bus.header(packet.payload)) is not None:
                if header.stamp_ns != bus.stamp_ns and not bus.tick_is_over:
                    break
                if header.stamp_ns > bus.stamp_ns:
                    bus.stamp_ns, bus.tick_is_over = header.stamp_ns, False
            packets.append(self._waiting.popleft())
        return packets


class _LockstepAir:
    """Shows what is visible in a tick all at once, when everybody who takes part has sent what belongs to it."""

    def __init__(self, bus: ImpairedBus, inbox: Inbox) -> None:
        self._bus, self._inbox = bus, inbox
        # Not yet on its link; one by stamp, sender and topic, so no more than are sent in a run, whoever floods. Who is
        # stopped finds minutes of them.
        self._here: dict[tuple[int, int, int], Sent] = {}
        self._others: list[Packet] = []  # what is no message of a peer
        self._newest_ns: dict[tuple[int, int], int] = {}  # by sender and topic
        self.shown_ns = -1  # stamp of the last tick whose packets were shown

    def drain(self) -> list[Packet]:
        self._take(self._inbox.drain())
        return self._show()

    def wait(self, timeout_s: float | None) -> list[Packet]:
        """Empty when nothing more will come in this tick (or, after a limit, if nothing has)."""
        packets = self.drain()
        while not packets and self.shown_ns != self._bus.stamp_ns:
            more = self._inbox.wait(timeout_s)
            if not more:
                break
            self._take(more)
            packets = self._show()
        return packets

    def _take(self, packets: Iterable[Packet]) -> None:
        for packet in packets:
            sent = self._bus.sent(packet)
            if sent is None:
                self._others.append(packet)
            else:
                self._here.setdefault((sent.stamp_ns, sent.sender, sent.topic), sent)
                place = sent.sender, sent.topic
                self._newest_ns[place] = max(sent.stamp_ns, self._newest_ns.get(place, -1))

    def _show(self) -> list[Packet]:
        shown, self._others = self._others, []
        now_ns, newest_ns = self._bus.stamp_ns, self._newest_ns
        # What a sender says on a topic arrives in order: what is not here by then has been lost on a broken link.
        if self.shown_ns == now_ns or not all(
            newest_ns.get((peer, topic), -1) >= now_ns for peer in self._bus.peers for topic in range(len(messages.AIR))
        ):
            return shown
        self.shown_ns = now_ns
        for place in sorted(place for place in self._here if place[0] <= now_ns):
            self._bus.in_flight.send(self._here.pop(place), now_ns)
        return shown + self._bus.in_flight.arrived(now_ns)


class _RealtimeSensors:
    """Sets the run's time by the first reading."""

    def __init__(self, bus: ImpairedBus, inbox: Inbox) -> None:
        self._bus, self._inbox = bus, inbox
        self._key = topics.key(topics.VIO, bus.mav)

    def drain(self) -> list[Packet]:
        return self._noted(self._inbox.drain())

    def wait(self, timeout_s: float | None) -> list[Packet]:
        return self._noted(self._inbox.wait(timeout_s))

    def _noted(self, packets: list[Packet]) -> list[Packet]:
        bus, passed = self._bus, list[Packet]()
        for packet in packets:
            if bus.is_roll(packet):
                continue  # in real time nobody waits for anybody
            if (
                packet.key == self._key
                and bus.tick_zero_s is None
                and (header := bus.header(packet.payload)) is not None
            ):
                bus.tick_zero_s = clock.now_s() - header.stamp_ns / 1e9
            passed.append(packet)
        return passed


class _RealtimeAir:
    """Shows each packet when its time has come."""

    def __init__(self, bus: ImpairedBus, inbox: Inbox) -> None:
        self._bus, self._inbox = bus, inbox

    def drain(self) -> list[Packet]:
        return self._passed(self._inbox.drain())

    def wait(self, timeout_s: float | None) -> list[Packet]:
        deadline_s = None if timeout_s is None else clock.now_s() + timeout_s
        packets = self.drain()
        while not packets and (deadline_s is None or clock.now_s() < deadline_s):
            ends_s = [each for each in (deadline_s, self._next_s()) if each is not None]
            packets = self._passed(self._inbox.wait(max(0.0, min(ends_s) - clock.now_s()) if ends_s else None))
        return packets

    def _passed(self, packets: list[Packet]) -> list[Packet]:
        now_ns, shown = self._now_ns(), list[Packet]()
        for packet in packets:
            sent = self._bus.sent(packet)
            if sent is None:
                shown.append(packet)
            else:
                self._bus.in_flight.send(sent, now_ns)
        return shown + self._bus.in_flight.arrived(now_ns)

    def _now_ns(self) -> int:
        zero_s = self._bus.tick_zero_s
        return 0 if zero_s is None else max(0, round((clock.now_s() - zero_s) * 1e9))

    def _next_s(self) -> float | None:
        next_ns, zero_s = self._bus.in_flight.next_ns, self._bus.tick_zero_s
        return None if next_ns is None or zero_s is None else zero_s + next_ns / 1e9
