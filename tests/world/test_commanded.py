"""Do the MAVs fly what their agents command, by their own odometry, the same whatever the order of the answers?"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from agent.interface import messages, topics
from agent.interface.bus import MemoryBus, Packet
from agent.interface.fleet import Fleet
from agent.interface.frames import compose, wrap
from world.clearance import STANDING_M
from world.commanded import CommandedFlight
from world.config import parse
from world.world import World

EPOCH = 3
FLEET = Fleet(mavs=3, duration_s=8.0, seed=4)
EXACT = {"odometry": {"position_sigma_m": 0.0, "yaw_sigma_rad": 0.0}}
LINE = {"formation": "line", "length_m": 8.0}
TABLE: dict[str, Any] = {"commanded": True, "path": [LINE]}
Pilot = Callable[[int, float], list[float]]  # of a MAV at a time, s: position, velocity, acceleration, yaw, 10 numbers


def flight(fleet: Fleet = FLEET, **more: object) -> CommandedFlight:
    return CommandedFlight(parse(TABLE | more, fleet), fleet)


def setpoint(mav: int, time_s: float, asked: list[float], seq: int = 0) -> messages.Setpoint:
    blocks = (np.array(asked[k : k + 3], float).tobytes() for k in (0, 3, 6))
    return messages.Setpoint(messages.VERSION, EPOCH, mav, seq, round(time_s * 1e9), *blocks, float(asked[9]))


def still(x: float, y: float, z: float, yaw: float = 0.0) -> list[float]:
    return [x, y, z, *[0.0] * 6, yaw]


def hop(mav: int, time_s: float) -> list[float]:
    """Take-off to a height of its own, then a metre and a bit aside with a turn."""
    height_m = 0.8 + 0.2 * mav
    return still(0.0, 0.0, height_m) if time_s < 2.5 else still(0.6, -0.3 * mav, height_m, 0.5)


def flown(motion: CommandedFlight, pilot: Pilot, duration_s: float, until_s: float = np.inf) -> CommandedFlight:
    """As a world flies it; after until_s nobody commands anything any more."""
    for tick in range(round(duration_s * 10)):
        if 1 <= tick <= until_s * 10:
            motion.command(setpoint(mav, (tick - 1) / 10, pilot(mav, (tick - 1) / 10)) for mav in FLEET.ids)
        motion.step()
    return motion


def commanded_places(pilot: Pilot, time_s: float) -> np.ndarray:
    """(N, 4) in the odometry frames."""
    asked = np.array([pilot(mav, time_s) for mav in FLEET.ids])
    return asked[:, [0, 1, 2, 9]]


def test_they_begin_standing_on_the_ground_and_stay_there() -> None:
    motion = flight(path=[LINE | {"center": [1.0, 2.0, 9.0], "height_step_m": 1.0}])
    start = motion.true.level
    np.testing.assert_allclose(start[:, :3], [[1, 6, STANDING_M], [1, 2, STANDING_M], [1, -2, STANDING_M]], atol=1e-12)
    assert np.ptp(start[:, 3]) > 0.5  # each its own way
    flown(motion, lambda mav, time_s: still(0, 0, 0.04), 5.0)  # too low to be a take-off
    np.testing.assert_allclose(motion.true.level, start, atol=1e-3)
    assert not motion._physics.thrusts.any()
    assert motion.contacts == set()  # the ground is none


def test_without_a_setpoint_they_stay() -> None:
    motion = flight()
    start = motion.true.level
    for _ in range(30):
        motion.step()
    np.testing.assert_allclose(motion.true.level, start, atol=1e-3)


def test_they_are_where_they_are_commanded_to_be() -> None:
    motion = flown(flight(**EXACT), hop, 6.0)
    wanted = compose(motion.pose_world_odom, commanded_places(hop, 6.0))
    np.testing.assert_allclose(motion.true.position, wanted[:, :3], atol=0.01)
    np.testing.assert_allclose(wrap(motion.true.level[:, 3] - wanted[:, 3]), 0, atol=0.02)


def test_the_drift_of_its_odometry_moves_a_mav() -> None:
    motion = flown(flight(odometry={"position_sigma_m": 0.02, "yaw_sigma_rad": 0.01}), hop, 6.0)
    wanted = compose(motion.pose_world_odom, commanded_places(hop, 6.0))
    off_m = np.linalg.norm(motion.true.position - wanted[:, :3], axis=1)
    assert off_m.min() > 0.06
    # By its odometry it is where it should be, but for what that jumps from tick to tick.
    np.testing.assert_allclose(motion.vio.position, commanded_places(hop, 6.0)[:, :3], atol=0.12)


def test_a_moving_setpoint_is_followed_between_ticks() -> None:
    def curve(mav: int, time_s: float) -> list[float]:
        t = max(time_s - 2.0, 0.0)
        return [t**2 / 4, t, 1.0, t / 2, float(t > 0), 0.0, 0.5 * (t > 0), 0.0, 0.0, 0.0]

    motion = flown(flight(**EXACT), curve, 5.0)
    wanted = compose(motion.pose_world_odom, commanded_places(curve, 5.0))
    np.testing.assert_allclose(motion.true.position, wanted[:, :3], atol=0.08)  # of 1.8 m/s


def test_the_setpoint_of_a_lost_agent_comes_to_rest_and_is_held() -> None:
    def climb(mav: int, time_s: float) -> list[float]:
        return [0.0, 0.0, 0.4 * time_s, 0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 0.0]

    motion = flown(flight(**EXACT), climb, 8.0, until_s=3.0)
    last_s = 2.9  # of the setpoint that was handed over at 3.0 s
    np.testing.assert_allclose(motion.true.position[:, 2], STANDING_M + 0.4 * (last_s + 0.5), atol=0.01)
    np.testing.assert_allclose(motion._physics.state.velocity, 0, atol=0.01)


def test_who_begins_its_odometry_anew_stays_where_it_is() -> None:
    motion = flown(flight(**EXACT), hop, 5.0)
    before = motion.true.level
    motion.begin_odometry(2)
    for _ in range(30):
        motion.step()
    np.testing.assert_allclose(motion.true.position, before[:, :3], atol=0.02)
    motion.command([setpoint(2, 8.0, still(0.5, 0.0, 0.0))])  # in the new frame; its rotors turn already
    for _ in range(30):
        motion.step()
    wanted = compose(before[1], np.array([0.5, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(motion.true.position[1], wanted[:3], atol=0.02)


def test_two_that_are_commanded_into_each_other_touch() -> None:
    def meet(mav: int, time_s: float) -> list[float]:
        if mav == 3 or time_s < 2.5:
            return still(0.0, 0.0, 1.0)
        return still(0.0, (2.0 if mav == 2 else -2.0) * min(time_s - 2.5, 1.0), 1.0)  # along the line

    motion, seen = flight(**EXACT, start_yaw="zero"), set()
    for tick in range(45):
        if tick:
            motion.command(setpoint(mav, (tick - 1) / 10, meet(mav, (tick - 1) / 10)) for mav in FLEET.ids)
        motion.step()
        seen |= motion.contacts
        apart_m = np.linalg.norm(motion.true.position[0] - motion.true.position[1])
        assert motion.contacts == set() or apart_m < 0.65
    assert seen == {(1, 2)}


class TestInTheWorld:
    """How setpoints come to be flown."""

    def answers(self, tick: int, pilot: Pilot = hop) -> list[Packet]:
        said = [setpoint(mav, tick / 10, pilot(mav, tick / 10), tick) for mav in FLEET.ids]
        return [Packet(topics.key(topics.COMMAND, each.sender), messages.encode(each)) for each in said]

    def truths(self, bus: MemoryBus) -> Iterator[tuple[str, bytes]]:
        return (packet for packet in self.heard.drain() if packet.key.startswith("truth"))

    def world(self, bus: MemoryBus, **more: object) -> World:
        self.heard = bus.another().subscribe("truth/*/*")
        return World(parse(TABLE | more, FLEET), FLEET, EPOCH, bus)

    def answered_first(self, **more: object) -> list[tuple[str, bytes]]:
        """As in one process: everybody answers, then the world steps."""
        bus = MemoryBus()
        world, agents = self.world(bus, **more), bus.another()
        world.begin()
        for tick in range(FLEET.ticks):
            world.publish_tick()
            for packet in self.answers(tick):
                agents.publish(*packet)
            assert world.answered()
            world.step()
        return list(self.truths(bus))

    def stepped_first(self, **more: object) -> list[tuple[str, bytes]]:
        """As with processes: the world steps while they think, and hears them one by one, the last MAV first."""
        pending: list[Packet] = []
        test = self

        class Agents(MemoryBus):
            def subscribe(self, pattern: str, *arguments: Any) -> Any:
                inbox = super().subscribe(pattern, *arguments)
                inbox.wait = lambda timeout_s: [pending.pop()]
                return inbox

            def publish(self, key: str, payload: bytes) -> None:
                super().publish(key, payload)
                if key == topics.key(topics.VIO, FLEET.mavs):
                    stamp_ns = messages.decode(messages.Vio, payload, EPOCH).stamp_ns
                    pending.extend(test.answers(round(stamp_ns / 1e8)))

        bus = Agents()
        self.world(bus, **more).run_lockstep()
        return list(self.truths(bus))

    def test_the_order_of_step_and_answers_makes_no_difference(self) -> None:
        windy = {"wind": {"mean_m_s": [2.0, 0.0, 0.0], "gust_sigma_m_s": 1.0}}
        first, second = self.answered_first(**windy), self.stepped_first(**windy)
        assert len(first) == 3 * 2 * FLEET.ticks
        assert first == second
        assert first != self.answered_first()

    def heights(self, ticks: int, said: dict[int, list[messages.Setpoint]], rolls: dict[int, dict[int, int]]) -> list:
        """Heights of MAV 1, given what it said after which tick was published."""
        bus = MemoryBus()
        world, agents, found = self.world(bus, **EXACT), bus.another(), []
        world.begin()
        for tick in range(ticks):
            if tick in rolls:
                world.set_roll(rolls[tick])
            world.publish_tick()
            for each in said.get(tick, []):
                agents.publish(topics.key(topics.COMMAND, 1), messages.encode(each))
            world.answered()
            world.step()
            found.append(world._motion.true.position[0, 2])
        return found

    def test_a_setpoint_stamped_k_is_flown_from_the_tick_after_on(self) -> None:
        heights = self.heights(8, {2: [setpoint(1, 0.2, still(0, 0, 1.0))]}, {})
        assert heights[2] == pytest.approx(STANDING_M, abs=1e-3)  # the step from tick 2 to 3
        assert heights[3] > STANDING_M + 0.005

    def test_the_newest_stamp_wins_and_none_is_from_the_future(self) -> None:
        low, high = still(0, 0, 0.5), still(0, 0, 2.0)
        said = {
            2: [setpoint(1, 0.2, low), setpoint(1, 0.2, high), setpoint(1, 0.1, high), setpoint(1, 9.9, high)],
            3: [setpoint(1, 0.1, high)],
        }
        assert self.heights(60, said, {})[-1] == pytest.approx(STANDING_M + 0.5, abs=0.01)

    def test_what_was_said_before_odometry_began_anew_is_not_flown(self) -> None:
        up, before = setpoint(1, 0.0, still(0, 0, 1.0)), setpoint(1, 3.9, still(0, 0, 3.0))
        rolls = {0: {1: 0, 2: 0, 3: 0}, 40: {1: 1, 2: 0, 3: 0}}
        for said_at in (39, 41):  # just before, and late
            heights = self.heights(70, {0: [up], said_at: [before]}, rolls)
            assert heights[-1] == pytest.approx(STANDING_M + 1.0, abs=0.02)

    def test_contacts_are_told_to_both_and_to_deploy_only(self) -> None:
        bus = MemoryBus()
        world, everything = self.world(bus), bus.another().subscribe("**")
        world._motion.contacts = {(1, 3), (2, 3)}
        world.publish_tick()
        said = [packet for packet in everything.drain() if packet.key.endswith("contact")]
        told = {packet.key: messages.decode(messages.Contact, packet.payload, EPOCH).others for packet in said}
        assert told == {"truth/1/contact": b"\3", "truth/2/contact": b"\3", "truth/3/contact": b"\1\2"}


def test_the_ground_is_level_but_for_the_places_drawn_on_it() -> None:
    """A box and jitter spread the MAVs on the ground; heights do not keep them apart."""
    for seed in range(20):
        fleet = Fleet(mavs=6, seed=seed)
        for leg in (
            {"formation": "box", "size_m": [4.0, 4.0, 3.0], "center": [0, 0, 0]},
            {"formation": "line", "length_m": 4.0, "jitter_m": 0.2, "height_step_m": 3.0},
        ):
            places = flight(fleet, path=[leg]).true.position
            np.testing.assert_allclose(places[:, 2], STANDING_M, atol=1e-12)
            apart_m = np.linalg.norm(places[:, None] - places, axis=-1)
            assert apart_m[~np.eye(6, dtype=bool)].min() >= 0.6
