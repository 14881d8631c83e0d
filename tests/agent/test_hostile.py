"""Can anybody harm an agent with what it sends? Fuzzed messages, floods, liars, jumping clocks. (All: `make fuzz`.)"""

import numpy as np
import pytest

from agent.interface import messages as m
from agent.interface import topics
from agent.interface.bus import Packet
from agent.sensing.inbox import AT_ONCE, Inbox
from agent.sensing.neighbours import Neighbours
from agent.sensing.own import WAITING, OwnSensors
from agent.sensing.own_time import CONFIRMED, OwnTime
from tests.agent.test_agent import EPOCH, Rig
from tests.hostile import Enemy, breaks

TICKS = 12
S = 10**9


def overheard(mavs=3, ticks=TICKS):
    """Everything that was said in a run of which nobody disturbs."""
    rig = Rig(mavs=mavs, ticks=ticks)
    rig.fly()
    return rig.out.drain()


def estimates(packets):
    return [p for p in packets if topics.parse(p.key)[0] is topics.ESTIMATE]


def attacked(rig, per_tick, seed=0, real=None):
    """Flies like Rig.fly, among broken packets; returns what the agents estimated."""
    enemy = Enemy(seed, rig.fleet.mavs, EPOCH, real or overheard())
    found = []
    rig.survey()
    for k in range(len(rig.ticks)):
        rig.k = k
        for when in range(2):  # when the last tick is over, and when the next has begun
            now_ns = rig.fleet.stamp_ns(max(k - 1 + when, 0))
            for _ in range(per_tick // 2):
                rig.bus.publish(*enemy.packet(now_ns))
            if not when:
                rig.sensors()
            rig.settle()
        found += [p for p in rig.out.drain() if p.key.startswith("belief/") and p.key.endswith("/estimate")]
    return found


def test_nothing_that_breaks_the_schema_is_accepted():
    rig, inbox = Rig(), Inbox(1, 3, EPOCH)
    for packet in (p for k in range(TICKS) for p in sensors(rig, k)):
        assert inbox.read(packet) is not None
    now_ns, neighbours = rig.fleet.stamp_ns(TICKS - 1), Neighbours(3, 10.0, 10)
    neighbours.take(TICKS - 1)
    enemy = Enemy(1, 3, EPOCH, overheard())
    for number in range(6000):
        packet = enemy.packet(now_ns)
        received = inbox.read(packet)
        if received is not None:  # then only its time is wrong, which is judged later
            stamp_ns = received.message.stamp_ns
            assert not neighbours.expects(stamp_ns) or stamp_ns > now_ns + 6.4 * S, packet
            if packet.key.startswith("air/"):
                before = neighbours.unbelieved
                assert neighbours.put(stamp_ns, received.mav, odometry=np.zeros(4)) is None
                assert neighbours.unbelieved == before + 1
        if number % AT_ONCE == 0:
            inbox.next_tick()
    assert inbox.rejected > 5000


def sensors(rig, k):
    rig.k = k
    rig.sensors(of=[1])
    return rig.out.drain()


def test_what_fits_the_plain_twin_fits_the_boundary():
    """Or the test before would be passed by an agent that believes nothing."""
    inbox, real = Inbox(1, 3, EPOCH), overheard()
    heard = [p for p in real if p.key.startswith(("sensor/1/", "air/2/", "air/3/"))]
    assert len(heard) > 6 * TICKS
    for packet in heard:
        inbox.next_tick()
        assert not breaks(packet, 3, EPOCH, TICKS * S)
        assert inbox.read(packet) is not None


def test_fuzzed_messages_change_no_bit_of_the_estimates():
    assert attacked(Rig(ticks=TICKS), 200) == estimates(overheard())


def test_a_run_that_is_played_again_changes_no_bit():
    """Of another epoch, and this one's own messages once more."""
    clean, rig, again = overheard(), Rig(ticks=TICKS), []
    old = [Packet(p.key, p.payload.replace(bytes([EPOCH]), bytes([EPOCH + 1]), 1)) for p in clean]
    rig.survey()
    for k in range(TICKS):
        rig.k = k
        for packet in old:
            rig.bus.publish(*packet)
        rig.sensors()
        rig.settle()
        said = rig.out.drain()
        again += [p for p in said if p.key.endswith("/estimate") and p not in old]
        for packet in said:
            if packet.key.startswith("air/") and packet not in old:
                rig.bus.publish(*packet)
    assert again == estimates(clean)


@pytest.mark.parametrize("valid", [True, False])
def test_a_flood_from_one_peer_is_cut_off_and_the_others_are_heard(valid):
    inbox = Inbox(1, 3, EPOCH)
    pose = np.zeros(4).tobytes()

    def said(mav):
        return m.encode(m.Odometry(m.VERSION, EPOCH, mav, 0, 0, pose))

    flood = Packet("air/2/odometry", said(2) if valid else said(3))
    accepted = sum(inbox.read(flood) is not None for _ in range(10_000))
    assert accepted == (AT_ONCE if valid else 0)
    assert inbox.rejected == 10_000 - accepted
    assert inbox.read(Packet("air/3/odometry", said(3))) is not None
    assert inbox.read(flood) is None
    inbox.next_tick()
    assert (inbox.read(flood) is not None) == valid
    assert len(inbox._counts) <= 3


def test_an_invented_crowd_of_senders_is_counted_as_one():
    inbox = Inbox(1, 3, EPOCH)
    for k in range(5000):
        inbox.read(Packet(f"air/{k}0000/odometry", b""))
    assert len(inbox._counts) == 1


def test_the_own_clock_may_jump_far_only_if_it_stays_there():
    time = OwnTime()
    assert all(time.believes(stamp) for stamp in (0, S, 61 * S, 3 * S))
    assert not time.believes(1000 * S)
    assert time.believes(62 * S)  # that was a slip
    answers = [time.believes(1000 * S + k * S // 10) for k in range(CONFIRMED)]
    assert answers == [False] * (CONFIRMED - 1) + [True]
    assert not any(time.believes(k * 10**6 * S) for k in range(1, 50))


def test_readings_that_wait_for_their_sets_are_bounded_and_do_not_go_back_in_time():
    own = OwnSensors()
    for stamp in range(3 * WAITING):
        own.put_vio(stamp, stamp)
    assert len(own._vio) == WAITING
    own.put_sightings(m.Sightings(1, 7, 0, 0, 3 * WAITING - 2, b""))
    reading = own.take()
    assert (reading.stamp_ns, reading.levelled) == (3 * WAITING - 2, 3 * WAITING - 2)
    own.put_vio(5, 5)
    own.put_sightings(m.Sightings(1, 7, 0, 0, 5, b""))
    assert own.take() is None
