"""Is a packet seen when the schedule says, in lockstep and in real time, and is everything else left alone?"""

from typing import Any

import numpy as np
import pytest

from agent.interface import clock, messages, topics
from agent.interface.bus import CAPACITY, MemoryBus, MemoryInbox, Packet
from agent.interface.fleet import Fleet
from deploy.faults import Faults, LinkRule, Partition, ProcessFault
from deploy.impaired_bus import ImpairedBus, Newcomers

EPOCH = 2**30
FLEET = Fleet(mavs=3, duration_s=10.0)
MS = 10**6
POSE = bytes(32)
ZEROS = bytes(24)


class Rig:
    """MAV 1 behind an impaired bus; the test plays the world and the peers 2 and 3."""

    def __init__(self, faults: Faults, fleet: Fleet = FLEET, **more: Any) -> None:
        self.fleet, self.outside = fleet, MemoryBus()
        self.heard = self.outside.subscribe("**")
        self.met: list[Newcomers] = []
        self.bus = ImpairedBus(self.outside.another(), faults, fleet, 1, EPOCH, meet=self.met.append, **more)
        self.sensors, self.air = self.bus.subscribe("sensor/1/*"), self.bus.subscribe("air/*/*")

    def send(self, topic: topics.Topic, mav: int, tick: int, *fields: object, sender: int = 0) -> Packet:
        header = (messages.VERSION, EPOCH, sender, tick, self.fleet.stamp_ns(tick))
        packet = Packet(topics.key(topic, mav), messages.encode_fields(topic.kind, *header, *fields))
        self.outside.publish(*packet)
        return packet

    def world(self, tick: int) -> list[Packet]:
        quaternion = np.array([0.0, 0, 0, 1]).tobytes()
        return [self.send(topics.VIO, 1, tick, ZEROS, quaternion), self.send(topics.SIGHTINGS, 1, tick, b"")]

    def peer(self, mav: int, tick: int) -> list[Packet]:
        odometry = self.send(topics.ODOMETRY, mav, tick, POSE, sender=mav)
        return [odometry, self.send(topics.DETECTIONS, mav, tick, b"", sender=mav)]

    def roll(self, tick: int, **incarnations: int) -> None:
        """mav_2=1 and so on."""
        members = {int(name[4:]): number for name, number in incarnations.items()}
        self.send(topics.ROLL, 1, tick, bytes(members), tuple(members.values()))

    def estimate(self, tick: int) -> None:
        """What the agent says at the end of a tick."""
        fields = (bytes([2, 0, 0]), bytes(96), bytes(120), bytes(32), 0, 0)
        header = (messages.VERSION, EPOCH, 1, tick, self.fleet.stamp_ns(tick))
        self.bus.publish(topics.key(topics.ESTIMATE, 1), messages.encode_fields(messages.Estimate, *header, *fields))

    def tick(self, tick: int) -> list[tuple[int, str, int]]:
        """All of a tick; what the agent sees of its peers in it, as sender, topic and tick."""
        self.world(tick)
        self.sensors.drain()
        for mav in (2, 3):
            self.peer(mav, tick)
        seen = self.air.drain()
        assert self.bus.all_shown
        assert self.air.wait(None) == []
        self.estimate(tick)
        return [self.named(packet) for packet in seen]

    def named(self, packet: Packet) -> tuple[int, str, int]:
        topic, mav = topics.parse(packet.key)
        message = messages.decode(topic.kind, packet.payload, EPOCH)
        return mav, topic.name, round(message.stamp_ns * self.fleet.rate_hz / 1e9)

    def journal(self) -> list[messages.Arrivals]:
        return [
            messages.decode(messages.Arrivals, packet.payload, EPOCH)
            for packet in self.heard.drain()
            if packet.key == "fault/1/arrivals"
        ]


def everything(tick: int) -> list[tuple[int, str, int]]:
    return [(mav, topic, tick) for mav in (2, 3) for topic in ("odometry", "detections")]


def test_without_a_delay_a_packet_is_seen_in_its_own_tick() -> None:
    rig = Rig(Faults(links=(LinkRule(until_s=0.1, loss=1.0),)))
    assert rig.tick(0) == []
    assert rig.tick(1) == everything(1)


@pytest.mark.parametrize(("delay_ms", "ticks"), [(1, 1), (100, 1), (101, 2), (250, 3)])
def test_a_delayed_packet_is_seen_in_the_first_tick_at_or_after_its_time(delay_ms: int, ticks: int) -> None:
    rig = Rig(Faults(delay_ms=delay_ms))
    seen = [rig.tick(k) for k in range(6)]
    assert seen == [[]] * ticks + [everything(k) for k in range(6 - ticks)]


def test_nothing_is_shown_before_everything_that_may_be_seen_in_the_tick_is_here() -> None:
    rig = Rig(Faults(links=(LinkRule(senders=(3,), loss=1.0),)))
    readings = rig.world(0)
    rig.peer(2, 0)
    assert rig.sensors.drain() == readings
    rig.send(topics.ODOMETRY, 3, 0, POSE, sender=3)
    assert rig.air.drain() == []
    assert not rig.bus.all_shown
    rig.send(topics.DETECTIONS, 3, 0, b"", sender=3)
    assert list(map(rig.named, rig.air.wait(None))) == everything(0)[:2]
    assert rig.air.wait(None) == []
    assert rig.air.drain() == []


def test_what_is_seen_does_not_depend_on_the_order_in_which_it_came() -> None:
    seen = []
    for order in ((2, 3), (3, 2)):
        rig = Rig(Faults(loss=0.3, delay_ms=50, jitter_ms=80, jitter="lognormal", duplicates=0.2), FLEET)
        found = []
        for k in range(30):
            rig.world(k)
            rig.sensors.drain()
            for mav in order:
                rig.peer(mav, k)
            found += rig.air.drain()
            rig.estimate(k)
        seen.append(found)
    assert seen[0] == seen[1]
    assert 60 < len(seen[0]) < 120


def test_the_journal_says_what_arrived_and_what_did_not() -> None:
    rig = Rig(Faults(delay_ms=100, links=(LinkRule(senders=(3,), from_s=0.2, loss=1.0),)))
    for k in range(4):
        rig.tick(k)
    pages = rig.journal()
    assert [(page.sender, page.seq, page.stamp_ns) for page in pages] == [(255, k, k * 100 * MS) for k in range(4)]
    assert [list(page.senders) for page in pages] == [[], [2, 2, 3, 3], [2, 2, 3, 3], [2, 2]]
    assert list(pages[1].topics) == [0, 1, 0, 1]
    assert np.frombuffer(pages[3].stamps, "<i8").tolist() == [200 * MS] * 2
    assert [page.dropped for page in pages] == [(0, 0, 0), (0, 0, 0), (0, 0, 2), (0, 0, 2)]


def test_duplicates_are_in_the_journal_twice() -> None:
    rig = Rig(Faults(duplicates=1.0))
    assert rig.tick(0) == [each for each in everything(0) for _ in range(2)]
    assert list(rig.journal()[0].senders) == [2] * 4 + [3] * 4


def test_only_peers_are_disturbed() -> None:
    rig = Rig(Faults(loss=1.0))
    command = rig.outside.subscribe("command/*")
    rig.bus.publish("command/1", b"go")
    assert command.drain() == [Packet("command/1", b"go")]
    other = rig.bus.subscribe("elsewhere/*")
    rig.outside.publish("elsewhere/1", b"x")
    assert other.drain() == [Packet("elsewhere/1", b"x")]


@pytest.mark.parametrize("key", ["air/2/odometry", "air/9/odometry", "air/1/odometry", "air/2/secrets"])
def test_what_is_no_message_of_a_peer_is_for_the_agent_to_reject(key: str) -> None:
    rig = Rig(Faults(loss=1.0))
    rubbish = Packet(key, b"\x95\x01\x02")
    rig.outside.publish(*rubbish)
    assert rig.air.drain() == [rubbish]
    header = (messages.VERSION, EPOCH + 1, 2, 0, 0)
    stranger = Packet(key, messages.encode(messages.Odometry(*header, POSE)))
    rig.outside.publish(*stranger)
    assert rig.air.wait(None) == [stranger]


def test_of_a_flood_one_packet_a_tick_is_kept() -> None:
    rig = Rig(Faults(delay_ms=5000))
    rig.world(0)
    rig.sensors.drain()
    for _ in range(CAPACITY + 10):
        rig.send(topics.ODOMETRY, 2, 0, POSE, sender=2)
    rig.peer(3, 0)
    rig.air.drain()
    assert len(rig.air._here) == 3


def test_who_was_stopped_for_minutes_finds_all_that_was_sent_meanwhile() -> None:
    ticks = CAPACITY // 4 + 100  # of four packets each: more than an inbox holds
    rig = Rig(Faults(delay_ms=1), Fleet(mavs=3, duration_s=ticks / 10))
    for tick in range(ticks):
        for mav in (2, 3):
            rig.peer(mav, tick)
        if tick % 100 == 0:  # its network goes on
            rig.air.drain()
    for tick in range(ticks):
        rig.world(tick)
        assert rig.sensors.drain()
        rig.air.drain()
        assert rig.bus.all_shown
        rig.estimate(tick)


class TestWhoTakesPart:
    FAULTS = Faults(delay_ms=1, processes=(ProcessFault(mav=3, do="kill", at_s=1.0),))

    def test_nobody_else_is_waited_for(self) -> None:
        rig = Rig(self.FAULTS)
        rig.roll(0, mav_1=0, mav_2=0)
        readings = rig.world(0)
        assert rig.sensors.drain() == readings  # the roll is not for the agent
        rig.peer(2, 0)
        assert rig.air.wait(None) == []
        assert rig.bus.all_shown
        assert rig.met == []  # who was there when this agent came is met already

    def test_newcomers_are_met_before_the_tick_begins(self) -> None:
        rig = Rig(self.FAULTS)
        rig.roll(0, mav_1=0, mav_2=0)
        rig.tick(0)
        rig.roll(1, mav_1=0, mav_2=1, mav_3=0)
        rig.sensors.drain()
        assert rig.met == [[(2, 1), (3, 0)]]
        rig.estimate(1)
        rig.roll(2, mav_1=0, mav_3=0)
        rig.sensors.drain()
        assert len(rig.met) == 1

    def test_who_was_stopped_lives_through_the_ticks_one_by_one(self) -> None:
        rig = Rig(self.FAULTS)
        rig.tick(0)
        rig.roll(1, mav_2=0, mav_3=0)
        sent = []
        for k in (1, 2, 3):
            if k == 2:
                rig.roll(k, mav_2=0)
            if k == 3:
                rig.roll(k, mav_1=0, mav_2=0)
            sent.append(rig.world(k))
            rig.peer(2, k)
            if k == 1:
                rig.peer(3, k)
        for k, readings in enumerate(sent, 1):
            assert rig.sensors.drain() == readings
            assert rig.sensors.drain() == []
            assert {each[2] for each in map(rig.named, rig.air.drain())} == {k - 1}
            rig.estimate(k)

    def test_packets_that_were_lost_while_it_was_stopped_are_not_waited_for(self) -> None:
        """A broken connection loses some; what comes later on the same key says so."""
        rig = Rig(self.FAULTS)
        rig.world(0)
        rig.sensors.drain()
        rig.peer(2, 1)
        rig.peer(3, 2)
        assert rig.air.wait(None) == []
        assert rig.bus.all_shown


class Clock:
    """A clock that only the test, or waiting, moves on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 100.0
        monkeypatch.setattr(clock, "now_s", lambda: self.now_s)
        monkeypatch.setattr(MemoryInbox, "wait", lambda inbox, timeout_s: self.wait(inbox, timeout_s))

    def wait(self, inbox: Any, timeout_s: float) -> list[Packet]:
        self.now_s += max(timeout_s, 0.001)
        return inbox.drain()  # type: ignore[no-any-return]


class TestRealTime:
    FLEET = Fleet(mavs=3, duration_s=10.0, realtime=True)

    @pytest.fixture
    def clock(self, monkeypatch: pytest.MonkeyPatch) -> Clock:
        return Clock(monkeypatch)

    def test_a_packet_is_seen_when_its_time_has_come(self, clock: Clock) -> None:
        rig = Rig(Faults(delay_ms=40), self.FLEET)
        rig.world(0)
        rig.sensors.drain()
        sent = rig.peer(2, 0)
        assert rig.air.drain() == []
        assert rig.air.wait(0.03) == []
        assert clock.now_s == pytest.approx(100.03)
        assert rig.air.wait(0.03) == sent
        assert clock.now_s == pytest.approx(100.04, abs=2e-3)

    def test_a_packet_comes_by_itself_if_nobody_hurries(self, clock: Clock) -> None:
        rig = Rig(Faults(delay_ms=40), self.FLEET)
        rig.world(0)
        rig.sensors.drain()
        sent = rig.peer(2, 0)
        assert rig.air.wait(None) == sent
        assert clock.now_s == pytest.approx(100.04, abs=2e-3)

    def test_the_schedule_follows_the_clock_whatever_a_sender_says_of_the_time(self, clock: Clock) -> None:
        cut = Partition(groups=((1,), (2,)), from_s=1.0, until_s=2.0)
        rig = Rig(Faults(partitions=(cut,)), self.FLEET)
        rig.world(0)
        rig.sensors.drain()
        clock.now_s += 1.5
        rig.peer(2, 0)
        kept = rig.peer(3, 0)
        assert rig.air.drain() == kept
        clock.now_s += 1.0
        assert len([*rig.peer(2, 15), *rig.air.drain()]) == 4
        rig.estimate(24)
        (page,) = rig.journal()
        assert (page.stamp_ns, page.dropped, list(page.senders)) == (2400 * MS, (0, 2, 0), [3, 3, 2, 2])

    def test_nobody_is_waited_for_and_sensors_pass(self, clock: Clock) -> None:
        rig = Rig(Faults(loss=0.1), self.FLEET)
        rig.roll(0, mav_1=0, mav_2=0)
        readings = [*rig.world(0), *rig.world(1)]
        assert rig.sensors.wait(0.1) == readings
        assert rig.air.wait(0.01) == []
        assert rig.met == []
