"""Does the loop publish what it should, wait for the right answers and count what went out?"""

import logging
from collections import defaultdict

import numpy as np
import pytest

from agent.interface import clock, messages, topics
from agent.interface.bus import MemoryBus, MemoryInbox, Packet
from agent.interface.fleet import Fleet
from agent.interface.frames import compose, inverse, range_and_bearing, relative_pose, rotation_matrix, yaw_of
from world.config import WorldConfig, parse
from world.world import FAREWELL_S, FAREWELLS, World

FLEET = Fleet(mavs=4, duration_s=2.0, seed=7)
TABLE = {
    "path": [
        {"formation": "circle", "radius_m": 1.35, "hold_s": 0.5},
        {"formation": "circle", "radius_m": 2.0, "move_s": 2.0},
    ]
}
SURVEYED: dict[str, object] = {"survey": {}}
EPOCH = 3


def config(**more: object) -> WorldConfig:
    return parse(TABLE | more, FLEET)


def answer(mav: int, stamp_ns: int, **changed: int) -> bytes:
    zero = np.zeros(3).tobytes()
    header = {"version": messages.VERSION, "epoch": EPOCH, "sender": mav, "seq": 0, "stamp_ns": stamp_ns} | changed
    return messages.encode(messages.Setpoint(*header.values(), zero, zero, zero, 0.0))


def command_key(mav: int) -> str:
    return topics.key(topics.COMMAND, mav)


def fly(fleet: Fleet = FLEET, **more: object) -> list[Packet]:
    """A whole run with agents that answer at once."""
    bus = MemoryBus()
    heard = bus.subscribe("**")
    world = World(parse(TABLE | more, fleet), fleet, EPOCH, bus.another())
    world.begin()
    tick = 0
    while not world.finished:
        world.publish_tick()
        world.step()
        for mav in fleet.ids:
            assert not world.answered()
            bus.publish(command_key(mav), answer(mav, fleet.stamp_ns(tick)))
        assert world.answered()
        tick += 1
    world.end()
    return [packet for packet in heard.drain() if not packet.key.startswith("command")]


def by_topic(packets: list[Packet]) -> dict[tuple[str, int], list]:
    """Decoded messages of each topic and MAV, in order."""
    heard = defaultdict(list)
    for key, payload in packets:
        topic, mav = topics.parse(key)
        heard[topic.name, mav].append(messages.decode(topic.kind, payload, EPOCH))
    return heard


def test_every_tick_every_mav_gets_its_readings() -> None:
    heard = by_topic(fly(**SURVEYED))
    for mav in FLEET.ids:
        for name in ("vio", "sightings", "truth", "labels"):
            sent = heard[name, mav]
            assert [each.seq for each in sent] == list(range(20))
            assert [each.stamp_ns for each in sent] == [FLEET.stamp_ns(tick) for tick in range(20)]
            assert {each.sender for each in sent} == {0}
        assert len(heard["survey", mav]) == len(heard["end", mav]) == 1
        assert heard["end", mav][0].stamp_ns == FLEET.stamp_ns(19)
        for sightings, labels in zip(heard["sightings", mav], heard["labels", mav], strict=True):
            assert len(messages.read_spherical(sightings.spherical)) == len(labels.targets)
            assert {labels.mav} == {mav}
            assert mav not in labels.targets
    assert len(heard) == 4 * 6 + 1


def test_nothing_of_the_truth_is_on_what_agents_may_read() -> None:
    heard = {key.split("/")[0] for key, _ in fly(**SURVEYED)}
    assert heard == {"truth", "sensor", "status"}


def test_readings_are_of_the_true_poses() -> None:
    exact = {"odometry": {"position_sigma_m": 0.0, "yaw_sigma_rad": 0.0}}
    sharp = {
        "detector": {"P_D": 0.999, "bearing_sigma_rad": 1e-4, "range_sigma_slope": 0.0, "range_sigma_offset_m": 1e-4}
    }
    heard = by_topic(fly(**exact, **sharp))
    position = np.array([[messages.floats(each.position) for each in heard["truth", mav]] for mav in FLEET.ids])
    quaternion = np.array([[messages.floats(each.quaternion) for each in heard["truth", mav]] for mav in FLEET.ids])
    pose = np.concatenate([position, yaw_of(quaternion)[..., None]], axis=-1)
    radius = np.linalg.norm(position[:, :, :2], axis=-1)
    np.testing.assert_allclose(radius[:, 0], 1.35, atol=1e-12)
    assert radius[:, -1].min() > 1.8
    off = []
    for i, mav in enumerate(FLEET.ids):
        for tick in range(20):
            vio = heard["vio", mav][tick]
            expected = relative_pose(pose[i, 0], pose[i, tick])
            np.testing.assert_allclose(messages.floats(vio.position), expected[:3], atol=1e-12)
            detections = messages.read_spherical(heard["sightings", mav][tick].spherical)
            rotation = rotation_matrix(quaternion[i, tick])
            for seen, target in zip(detections, heard["labels", mav][tick].targets, strict=True):
                if target:
                    apart = (position[target - 1, tick] - position[i, tick]) @ rotation
                    off.append(seen - range_and_bearing(apart))
    assert np.abs(off).max() < 6e-4  # six times the noise
    assert np.abs(np.mean(off, axis=0)).max() < 2e-5


def test_the_survey_is_rough_and_exact_about_oneself() -> None:
    heard = by_topic(fly(**SURVEYED))
    start = np.array(
        [
            [*messages.floats(first.position), yaw_of(messages.floats(first.quaternion))]
            for first in (heard["truth", mav][0] for mav in FLEET.ids)
        ]
    )
    errors = []
    for i, mav in enumerate(FLEET.ids):
        survey = heard["survey", mav][0]
        poses = messages.floats(survey.poses).reshape(4, 4)
        assert (poses[i] == 0).all()
        assert (survey.position_sigma_m, survey.yaw_sigma_rad) == (0.2, 0.1)
        errors.extend(np.delete(compose(inverse(compose(inverse(start[i]), start)), poses), i, axis=0))
    errors = np.array(errors)
    assert 0.1 < errors[:, :3].std() < 0.3
    assert 0.04 < errors[:, 3].std() < 0.2


def test_without_a_survey_nobody_is_told_anything() -> None:
    unsurveyed = fly()
    assert not [key for key, _ in unsurveyed if key.endswith("survey")]
    told = [packet for packet in fly(**SURVEYED) if not packet.key.startswith("status") and "survey" not in packet.key]
    assert [packet for packet in unsurveyed if not packet.key.startswith("status")] == told


def test_the_same_seed_publishes_the_same_bytes_and_another_does_not() -> None:
    first, again = ([each for each in fly(**SURVEYED) if each.key != "status/0"] for _ in range(2))
    assert first == again
    other = fly(Fleet(mavs=4, duration_s=2.0, seed=8), **SURVEYED)
    for name in ("vio", "sightings", "survey", "pose", "labels"):
        pairs = [(a, b) for a, b in zip(first, other, strict=False) if a.key.endswith(name)]
        assert pairs
        assert any(a != b for a, b in pairs)


@pytest.mark.parametrize("rate_hz", [7.0, 30.0, 200.0])
def test_any_rate_ends_where_the_path_does(rate_hz: float) -> None:
    heard = by_topic(fly(Fleet(mavs=2, duration_s=3.0, rate_hz=rate_hz)))
    assert len(heard["truth", 1]) == round(3 * rate_hz)
    last = messages.floats(heard["truth", 1][-1].position)
    assert np.linalg.norm(last[:2]) == pytest.approx(2.0, abs=0.03)


def test_the_final_status_counts_every_message() -> None:
    packets = fly(**SURVEYED)
    assert packets[-1].key == "status/0"
    status = messages.decode(messages.Status, packets[-1].payload, EPOCH)
    assert status.final
    assert status.sender == 0
    assert status.sent == len(packets)
    assert status.sent_bytes == sum(len(payload) for _, payload in packets[:-1])  # its own size it cannot know
    assert status.received == 4 * 20
    assert status.rejected == status.late == status.late_ticks == 0


def test_messages_are_encoded_as_their_kinds_are() -> None:
    for key, payload in fly(**SURVEYED):
        assert messages.encode(messages.decode(topics.parse(key)[0].kind, payload, EPOCH)) == payload


def test_only_the_setpoint_of_this_tick_and_of_its_owner_is_an_answer(caplog: pytest.LogCaptureFixture) -> None:
    bus = MemoryBus()
    world = World(config(), FLEET, EPOCH, bus.another())
    world.publish_tick()
    world.step()
    world.publish_tick()
    stamp_ns = FLEET.stamp_ns(1)
    for mav in (1, 2, 3):
        bus.publish(command_key(mav), answer(mav, stamp_ns))
    bus.publish(command_key(4), answer(4, FLEET.stamp_ns(0)))  # too late: not an answer, but nothing wrong with it
    with caplog.at_level(logging.WARNING):
        for payload in (b"", b"\xff" * 20, answer(4, stamp_ns, epoch=9), answer(4, stamp_ns, version=2)):
            bus.publish(command_key(4), payload)
        bus.publish(command_key(4), answer(3, stamp_ns))
        bus.publish(command_key(9), answer(4, stamp_ns))
        bus.publish(command_key(3), b"\x00" * 100_000)
        assert not world.answered()
    assert (world.received, world.rejected) == (4, 7)
    assert [record.message.split("message at ")[1].split()[0] for record in caplog.records] == [
        "command/4",
        "command/9",
        "command/3",
    ]
    bus.publish(command_key(4), answer(4, stamp_ns))
    assert world.answered()


def test_lockstep_waits_for_answers() -> None:
    class Agents(MemoryBus):
        """Answers only when it is waited for, one MAV at a time."""

        def subscribe(self, pattern: str):
            inbox, pending = super().subscribe(pattern), []
            self.pending = pending

            def wait(timeout_s: float | None) -> list[Packet]:
                assert timeout_s is None
                return [pending.pop(0)]

            inbox.wait = wait
            return inbox

        def publish(self, key: str, payload: bytes) -> None:
            super().publish(key, payload)
            if key.endswith("vio"):
                mav = int(key.split("/")[1])
                stamp_ns = messages.decode(messages.Vio, payload, EPOCH).stamp_ns
                self.pending.append(Packet(command_key(mav), answer(mav, stamp_ns)))

    bus = Agents()
    world = World(config(), FLEET, EPOCH, bus)
    world.run_lockstep()
    assert world.finished
    assert world.received == 80
    assert bus.pending == []


def in_real_time(
    monkeypatch: pytest.MonkeyPatch,
    silent_at: tuple[int, ...] = (),
    slow_at: dict[int, float] | None = None,
    lasts_s: float = 2.0,
) -> tuple[np.ndarray, messages.Status]:
    """A run by a clock of its own: when every tick was published, s, and the final status.

    The agents answer when told so, but MAV 2 is silent at some ticks; publishing takes 0.01 s, at some ticks longer."""
    now_s, published_s = [100.0], []

    def sleep_until(deadline_s: float) -> None:
        now_s[0] = max(now_s[0], deadline_s)

    class Agents(MemoryBus):
        """MAV 1 is the first to be told; every MAV answers as soon as it is told."""

        def publish(self, key: str, payload: bytes) -> None:
            super().publish(key, payload)
            if not key.endswith("vio"):
                return
            mav, tick = int(key.split("/")[1]), len(published_s) - (key != "sensor/1/vio")
            if mav == 1:
                published_s.append(now_s[0] - 100)
                now_s[0] += (slow_at or {}).get(tick, 0.01)
            if not (mav == 2 and tick in silent_at):
                agents.publish(command_key(mav), answer(mav, FLEET.stamp_ns(tick)))

    bus = Agents()
    agents, heard = bus.another(), bus.another().subscribe("status/0")
    monkeypatch.setattr(clock, "now_s", lambda: now_s[0])
    monkeypatch.setattr(clock, "sleep_until", sleep_until)
    World(config(), FLEET, EPOCH, bus).run_realtime()
    # Every tick has its period, the last one too; then it says some times that it is over.
    assert now_s[0] - 100 == pytest.approx(lasts_s + FAREWELLS * FAREWELL_S)
    *_, status = heard.drain()
    return np.array(published_s), messages.decode(messages.Status, status.payload, EPOCH)


def test_real_time_is_paced(monkeypatch: pytest.MonkeyPatch) -> None:
    published_s, status = in_real_time(monkeypatch)
    np.testing.assert_allclose(published_s, np.arange(20) / 10, atol=1e-9)
    assert (status.late_ticks, status.late, status.received) == (0, 0, 80)


def test_a_tick_that_is_published_too_late_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    # Tick 5 holds up 6 and 7 (due 0.1 and 0.2 s after it); from 8 on all is in time again. 11 comes less than half a
    # period after its time.
    published_s, status = in_real_time(monkeypatch, slow_at={5: 0.27, 10: 0.14})
    np.testing.assert_allclose(published_s[:13], [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.77, 0.78, 0.8, 0.9, 1, 1.14, 1.2])
    assert status.late_ticks == 2


def test_simulated_time_stands_still_with_the_world(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("world.world.STOOD_STILL_S", 0.3)
    published_s, status = in_real_time(monkeypatch, slow_at={5: 0.5}, lasts_s=2.4)
    np.testing.assert_allclose(published_s[4:9], [0.4, 0.5, 1.0, 1.1, 1.2])
    assert caplog.messages == ["stood still for 0.4 s; simulated time goes on from there"]
    assert status.late_ticks == 1


def test_a_tick_that_some_mav_has_not_answered_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    published_s, status = in_real_time(monkeypatch, silent_at=(0, 3, 4, 19))
    np.testing.assert_allclose(published_s, np.arange(20) / 10, atol=1e-9)  # it waits for nobody
    assert (status.late_ticks, status.received) == (4, 76)


def test_a_tick_is_late_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert in_real_time(monkeypatch, silent_at=(6,), slow_at={5: 0.17})[1].late_ticks == 1


def test_an_answer_that_comes_before_the_next_tick_is_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """The world hears answers when the next tick is due, so an agent may take the whole period."""
    now_s, agents = [100.0], MemoryBus()

    def sleep_until(deadline_s: float) -> None:
        tick = round((now_s[0] - 100) * 10)
        for mav in FLEET.ids:
            agents.publish(command_key(mav), answer(mav, FLEET.stamp_ns(tick)))
        now_s[0] = deadline_s

    monkeypatch.setattr(clock, "now_s", lambda: now_s[0])
    monkeypatch.setattr(clock, "sleep_until", sleep_until)
    world = World(config(), FLEET, EPOCH, agents.another())
    world.run_realtime()
    assert (world.late_ticks, world.received) == (0, 80)


class TestTheRoll:
    """Who takes part, and what becomes of those who begin anew."""

    def rig(self, **more: object) -> tuple[World, MemoryBus, MemoryInbox]:
        bus = MemoryBus()
        heard = bus.subscribe("**")
        return World(config(**more), FLEET, EPOCH, bus.another()), bus, heard

    def test_only_those_who_take_part_are_waited_for(self) -> None:
        world, bus, heard = self.rig()
        world.begin()
        world.set_roll({2: 0, 1: 0, 4: 0})
        world.publish_tick()
        for mav in (1, 2):
            bus.publish(command_key(mav), answer(mav, 0))
        assert not world.answered()
        bus.publish(command_key(4), answer(4, 0))
        assert world.answered()
        said = by_topic(heard.drain())
        assert {len(said["roll", mav]) for mav in FLEET.ids} == {1}
        (roll,) = said["roll", 3]
        assert (list(roll.mavs), roll.incarnations, roll.stamp_ns) == ([1, 2, 4], (0, 0, 0), 0)
        assert len(said["vio", 3]) == 1  # its sensors go on
        world.step()
        world.set_roll({1: 0, 2: 0, 3: 0, 4: 1})
        (roll,) = by_topic(heard.drain())["roll", 1]
        assert (roll.seq, list(roll.mavs), roll.incarnations, roll.stamp_ns) == (1, [1, 2, 3, 4], (0, 0, 0, 1), 10**8)

    def test_nobody_may_take_part(self) -> None:
        world, _, _ = self.rig()
        world.begin()
        world.set_roll({})
        world.publish_tick()
        assert world.answered()

    def test_who_begins_anew_or_late_has_a_new_odometry_frame_where_it_is(self) -> None:
        exact = {"odometry": {"position_sigma_m": 0.0, "yaw_sigma_rad": 0.0}}
        world, _, heard = self.rig(**exact)
        world.begin()
        rolls = {0: {1: 0, 2: 0, 3: 0}, 12: {1: 0, 3: 0}, 15: {1: 0, 2: 1, 3: 0, 4: 0}, 17: {1: 0, 2: 1, 3: 0, 4: 0}}
        for tick in range(20):
            if tick in rolls:
                world.set_roll(rolls[tick])
            world.publish_tick()
            world.step()
        said = by_topic(heard.drain())
        for mav, began in ((1, 0), (2, 15), (3, 0), (4, 15)):
            true = [_level(each) for each in said["truth", mav]]
            read = [_level(each) for each in said["vio", mav]]
            for tick in range(20):
                frame = true[began if tick >= began else 0]
                np.testing.assert_allclose(read[tick], relative_pose(frame, true[tick]), atol=1e-9)
            tilt = rotation_matrix(messages.floats(said["vio", mav][19].quaternion))[2]
            np.testing.assert_allclose(
                tilt, rotation_matrix(messages.floats(said["truth", mav][19].quaternion))[2], atol=1e-9
            )


def _level(message: messages.Truth | messages.Vio) -> np.ndarray:
    return np.array([*messages.floats(message.position), yaw_of(messages.floats(message.quaternion))])
