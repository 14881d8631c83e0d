"""Own sensors levelled, foreign packets checked, ticks gathered."""

import logging

import msgpack
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agent.interface import messages as m
from agent.interface.bus import Packet
from agent.interface.frames import direction, range_and_bearing
from agent.sensing import detections, vio
from agent.sensing.inbox import Inbox
from agent.sensing.neighbours import AHEAD, Neighbours


def test_tilt_is_taken_out_of_what_the_camera_sees():
    rng = np.random.default_rng(0)
    orientation = Rotation.from_euler("ZYX", [1.1, 0.2, -0.3])
    reading = vio.read(m.Vio(1, 7, 0, 0, 0, np.array([1.0, 2, 3]).tobytes(), orientation.as_quat().tobytes()))
    np.testing.assert_allclose(reading.pose, [1, 2, 3, 1.1])
    lines_odom = rng.normal(size=(5, 3)) * 3  # from the MAV, in its odometry axes
    in_camera = range_and_bearing(orientation.inv().apply(lines_odom))
    set_ = m.Sightings(1, 7, 0, 0, 0, m.spherical_block(in_camera))
    levelled = detections.levelled(set_, reading.tilt)
    vectors = levelled[:, :1] * direction(levelled[:, 1], levelled[:, 2])
    expected = Rotation.from_euler("z", -1.1).apply(lines_odom)
    np.testing.assert_allclose(vectors, expected, atol=1e-5)


def odometry(mav=2, epoch=7, version=1, x=1.0):
    return msgpack.packb([version, epoch, mav, 0, 0, np.array([x, 0, 0, 0]).tobytes()])


@pytest.mark.parametrize(
    ("key", "payload", "reason"),
    [
        ("air/2/odometry", b"", "malformed"),
        ("air/2/odometry", b"\xff" * 30, "malformed"),
        ("air/2/odometry", odometry()[:-3], "malformed"),
        ("air/2/odometry", odometry(x=np.nan), "malformed"),
        ("air/2/odometry", bytes(70_000), "oversized"),
        ("air/2/odometry", odometry(version=9), "version"),
        ("air/2/odometry", odometry(epoch=8), "epoch"),
        ("air/3/odometry", odometry(mav=2), "sender"),
        ("air/9/odometry", odometry(mav=9), "sender"),
        ("air/2/rumours", odometry(), "topic"),
        ("air/²/odometry", odometry(), "topic"),
        ("nonsense", b"", "topic"),
        ("sensor/1/survey", m.encode(m.Survey(1, 7, 0, 0, 0, bytes(64), 0.2, 0.1)), "malformed"),
    ],
)
def test_bad_packets_are_counted_and_logged_once_per_sender(key, payload, reason, caplog):
    inbox = Inbox(mav=1, mavs=3, epoch=7)
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            assert inbox.read(Packet(key, payload)) is None
    assert (inbox.received, inbox.rejected) == (3, 3)
    assert len(caplog.records) == 1
    assert reason in caplog.text
    assert inbox.read(Packet("air/2/odometry", odometry())) is not None


def test_logging_is_bounded_under_a_flood_of_keys(caplog):
    inbox = Inbox(mav=1, mavs=3, epoch=7)
    for k in range(3000):
        inbox.read(Packet(f"air/{k}/rubbish", b""))
    assert inbox.rejected == 3000
    assert len(caplog.records) <= 1000


def stamp(tick):
    return tick * 10**8


def test_a_tick_is_complete_with_everybodys_data():
    neighbours = Neighbours(2, 10.0, lag=10)
    neighbours.put(stamp(5), 1, odometry=np.zeros(4), detections=np.zeros((0, 3)))
    neighbours.put(stamp(5), 2, odometry=np.ones(4))
    assert not neighbours.complete(5)
    neighbours.put(stamp(5), 2, detections=np.zeros((1, 3)))
    assert neighbours.complete(5)
    tick = neighbours.take(5)
    assert (set(tick.odometry), set(tick.detections)) == ({1, 2}, {1, 2})


def test_late_data_is_of_use_within_the_lag_and_counted_beyond():
    neighbours = Neighbours(2, 10.0, lag=10)
    assert neighbours.put(stamp(20), 2, odometry=np.zeros(4)) is None  # not late
    neighbours.take(20)
    assert neighbours.put(stamp(20), 2, detections=np.zeros((0, 3))) == 20
    assert neighbours.put(stamp(11), 2, odometry=np.zeros(4)) == 11  # in tick 21 it will be 10 ticks late
    assert neighbours.late == 0
    assert neighbours.put(stamp(10), 2, odometry=np.zeros(4)) is None
    assert (neighbours.late, neighbours.duplicate, neighbours.unbelieved) == (1, 0, 0)


@pytest.mark.parametrize("late", [False, True])
def test_repetitions_are_counted_and_the_first_holds(late):
    neighbours = Neighbours(2, 10.0, lag=10)
    if late:
        neighbours.take(7)
    assert neighbours.put(stamp(5), 1, odometry=np.zeros(4)) == (5 if late else None)
    assert neighbours.put(stamp(5), 1, odometry=np.ones(4)) is None
    assert neighbours.put(stamp(5), 1, odometry=np.ones(4)) is None
    assert neighbours.duplicate == 2
    assert late or neighbours.take(5).odometry[1].sum() == 0


@pytest.mark.parametrize("off", [stamp(AHEAD + 1), stamp(10**6), 3 * 10**7, 2**61])
def test_who_is_far_ahead_or_off_the_beat_is_not_believed(off):
    neighbours = Neighbours(2, 10.0, lag=10)
    neighbours.take(0)
    assert neighbours.put(off, 2, odometry=np.zeros(4)) is None
    assert neighbours.unbelieved == 1
    neighbours.put(stamp(AHEAD) + 10**7, 2, odometry=np.zeros(4))  # a little off the beat is on it
    assert neighbours.unbelieved == 1


def test_own_time_goes_forward_only():
    neighbours = Neighbours(2, 10.0, lag=10)
    assert neighbours.expects(stamp(0))
    neighbours.take(20)
    assert [neighbours.expects(stamp(k)) for k in (19, 20, 21, 1000)] == [False, False, True, True]
    assert not neighbours.expects(stamp(21) + 4 * 10**7)


@pytest.mark.parametrize("began", [False, True])
def test_what_waits_is_bounded_whatever_is_sent(began):
    rng, neighbours = np.random.default_rng(0), Neighbours(2, 10.0, lag=10)
    if began:
        neighbours.take(100)
    for number in [*range(10_000, 0, -1), *rng.integers(-(10**9), 10**9, 10_000).tolist()]:
        neighbours.put(stamp(number), 2, odometry=np.zeros(4))
        assert len(neighbours._ticks) <= AHEAD + 11
    if began:
        assert neighbours.put(stamp(101), 1, odometry=np.zeros(4)) is None
        assert set(neighbours.take(101).odometry) == {1, 2}


def test_who_counts_anew_has_been_restarted_and_whose_packets_are_out_of_order_has_not():
    neighbours = Neighbours(2, 10.0, lag=10)
    arrived = [(0, 5), (1, 6), (3, 8), (2, 7), (3, 8), (60, 0), (4, 9), (61, 1), (120, 0), (121, 40)]
    found = [neighbours.restarted(stamp(tick), 2, seq) for tick, seq in arrived]
    assert found == [False] * 5 + [True, False, False, True, False]
    assert not neighbours.restarted(stamp(200), 1, 0)  # another
