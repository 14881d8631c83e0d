"""How does a run go? Tick by tick: publish what the sensors read and what is true, step, wait for the answers."""

import logging
from collections.abc import Callable, Iterable
from typing import Protocol

import numpy as np

from agent.interface import clock, messages, topics
from agent.interface.bus import Bus, Packet
from agent.interface.fleet import Fleet
from agent.interface.frames import Array, relative_pose
from agent.interface.seeds import generator
from world.config import Survey, WorldConfig
from world.detector import Detectors
from world.poses import Poses
from world.recorded import RecordedFlights

BeforeTick = Callable[[int], None]
SENDER = 0  # the world among the MAVs 1..N

FAREWELLS, FAREWELL_S = 5, 0.05  # real time: networks lose messages, and those who do not hear of the end wait for ever
STOOD_STILL_S = 1.0  # real time: so late, it was not slow but stopped

log = logging.getLogger("world")


class Motion(Protocol):
    """Where the MAVs are: simulated or recorded, never asked which."""

    pose_world_odom: Array  # (N, 4) x y z m, yaw rad: where each MAV's odometry frame is at tick 0
    contacts: set[tuple[int, int]]  # pairs of MAV numbers, ascending, that have touched since the tick before

    @property
    def true(self) -> Poses:
        """This tick's, in the world frame."""

    @property
    def vio(self) -> Poses:
        """This tick's, each in its MAV's odometry frame."""

    def step(self) -> None:
        """On to the next tick."""

    def begin_odometry(self, mav: int) -> None:
        """From this tick on, the odometry frame of this MAV is where it is now."""

    def command(self, setpoints: Iterable[messages.Setpoint]) -> None:
        """From the next step on, the senders of these fly by them, where MAVs fly what is commanded."""


class World:
    """One run. Call begin, then publish_tick and step in turn until it is finished, then end."""

    def __init__(self, config: WorldConfig, fleet: Fleet, epoch: int, bus: Bus) -> None:
        """
        Raises:
            BadExperiment: the path or the recordings cannot be flown.
        """
        self._config, self._fleet, self._epoch, self._bus = config, fleet, epoch, bus
        self._motion: Motion = _motion(config, fleet)
        self._detectors = Detectors(config.detector, fleet)
        self._sets = self._detectors.detect(self._motion.true)
        self._inbox = bus.subscribe(topics.all_keys(topics.COMMAND))
        self._commander = {topics.key(topics.COMMAND, mav): mav for mav in fleet.ids}
        self._keys = [
            tuple(
                topics.key(topic, mav)
                for topic in (topics.TRUTH, topics.LABELS, topics.VIO, topics.SIGHTINGS, topics.CONTACT)
            )
            for mav in fleet.ids
        ]
        self._tick = 0
        self._roll = dict.fromkeys(fleet.ids, 0)  # who takes part -> how often it has been started anew
        self._started = set(self._roll.items())  # all that ever took part
        self._rolls = 0
        self._absent: set[int] = set()
        self._unanswered: set[int] = set()
        self._complained: set[str] = set()
        self._answered_stamp_ns = -1
        self._commanded: dict[int, messages.Setpoint] = {}  # by MAV, since the last tick
        self._newest_ns = dict.fromkeys(fleet.ids, -1)  # the stamp of each one's newest setpoint: older ones are no use
        self._tick_us = 0
        self.sent = self.sent_bytes = self.received = self.rejected = self.late_ticks = 0

    @property
    def finished(self) -> bool:
        return self._tick >= self._fleet.ticks

    def begin(self) -> None:
        """Tells every agent, roughly, where the odometry frames are."""
        if isinstance(self._config.survey, Survey):
            for mav in self._fleet.ids:
                survey = self._survey(mav, self._config.survey)
                self._publish(topics.key(topics.SURVEY, mav), messages.encode(survey))

    def set_roll(self, roll: dict[int, int]) -> None:
        """From the next tick to be published on, only these take part: nobody else is waited for.

        One that takes part for the first time, or has been started anew since, has a new odometry frame: where it is
        now. Everybody is told, so that who has been stopped can know later who took part meanwhile.

        Args:
            roll: by MAV, how often it has been started anew.
        """
        if self._tick == 0:  # nobody has begun before
            self._started = set(roll.items())
        for mav, _ in sorted(roll.items() - self._started):
            self._motion.begin_odometry(mav)
            self._commanded.pop(mav, None)
            self._newest_ns[mav] = self._fleet.stamp_ns(self._tick) - 1
        self._started |= roll.items()
        self._roll = dict(sorted(roll.items()))
        header = (messages.VERSION, self._epoch, SENDER, self._rolls, self._fleet.stamp_ns(self._tick))
        called = messages.encode(messages.Roll(*header, bytes(self._roll), tuple(self._roll.values())))
        self._rolls += 1
        for mav in self._fleet.ids:
            self._publish(topics.key(topics.ROLL, mav), called)

    def set_absent(self, mavs: set[int]) -> None:
        """In real time, sensors of MAVs without a process are off: the next one begins with a new odometry frame."""
        self._absent = mavs if self._fleet.realtime else set()

    def publish_tick(self) -> None:
        """What every MAV's sensors read at this tick and, for deploy alone, what is true.

        What has been commanded up to now is flown from here on. In lockstep, these are the answers to the tick before:
        a setpoint stamped k leads from tick k + 1 to k + 2, whether the step from k to k + 1 is before the answers to
        tick k or after them.
        """
        began_us = clock.now_us()
        tick, stamp_ns = self._tick, self._fleet.stamp_ns(self._tick)
        header = (messages.VERSION, self._epoch, SENDER, tick, stamp_ns)
        self._motion.command(self._commanded.values())
        self._commanded.clear()
        self._unanswered, self._answered_stamp_ns = set(self._roll), stamp_ns
        true, vio = self._motion.true, self._motion.vio
        for i, mav in enumerate(self._fleet.ids):
            truth_key, labels_key, vio_key, sightings_key, contact_key = self._keys[i]
            detections = self._sets[i]
            p, q = true.position[i].tobytes(), true.quaternion[i].tobytes()
            self._publish(truth_key, messages.encode_fields(messages.Truth, *header, mav, p, q))
            self._publish(
                labels_key, messages.encode_fields(messages.Labels, *header, mav, detections.labels.tobytes())
            )
            others = sorted(a + b - mav for a, b in self._motion.contacts if mav in (a, b))
            if others:
                self._publish(contact_key, messages.encode_fields(messages.Contact, *header, mav, bytes(others)))
            if mav in self._absent:
                continue
            p, q = vio.position[i].tobytes(), vio.quaternion[i].tobytes()
            self._publish(vio_key, messages.encode_fields(messages.Vio, *header, p, q))
            block = messages.spherical_block(detections.spherical)
            self._publish(sightings_key, messages.encode_fields(messages.Sightings, *header, block))
        self._tick_us = clock.now_us() - began_us

    def step(self) -> None:
        """On to the next tick. What is flown does not depend on the answers to this one: it may run before them."""
        began_us = clock.now_us()
        self._tick += 1
        if not self.finished:
            self._motion.step()
            self._sets = self._detectors.detect(self._motion.true)
        self._tick_us += clock.now_us() - began_us

    def answered(self) -> bool:
        """Whether everybody who takes part has commanded something for the tick that was published last."""
        self._receive(self._inbox.drain())
        return not self._unanswered

    def end(self) -> None:
        """Says that it is over, and how many messages there should have been."""
        last = max(self._tick - 1, 0)
        header = (messages.VERSION, self._epoch, SENDER, 0, self._fleet.stamp_ns(last))
        for mav in self._fleet.ids:
            self._publish(topics.key(topics.END, mav), messages.encode(messages.End(*header)))
        self._publish(topics.key(topics.STATUS, SENDER), messages.encode(self._final_status(header)))

    def run_lockstep(self, before_tick: BeforeTick = lambda _: None) -> None:
        """As fast as the slowest agent answers; `before_tick` is called before each."""
        self.begin()
        while not self.finished:
            before_tick(self._tick)
            self.publish_tick()
            self.step()
            while not self.answered():
                self._receive(self._inbox.wait(None))
        self.end()

    def run_realtime(self, before_tick: BeforeTick = lambda _: None) -> None:
        """By the wall clock, waiting for nobody.

        A tick is late if it was published more than half a period after its time, or if some MAV had not answered it
        when the next one was due. The last one, too, gets a period to be answered. If this process was stopped, so was
        simulated time: it does not hurry to make up for it.
        """
        self.begin()
        began_s, period_s = clock.now_s(), 1 / self._fleet.rate_hz
        while not self.finished:
            due_s = began_s + self._tick * period_s
            behind_s = clock.now_s() - due_s
            punctual = behind_s <= period_s / 2
            if behind_s > max(STOOD_STILL_S, period_s):
                log.warning("stood still for %.1f s; simulated time goes on from there", behind_s)
                began_s, due_s = began_s + behind_s, due_s + behind_s
            before_tick(self._tick)
            self.publish_tick()
            self.step()
            clock.sleep_until(due_s + period_s)
            self.late_ticks += not (self.answered() and punctual)
        for _ in range(FAREWELLS):
            self.end()
            clock.sleep_until(clock.now_s() + FAREWELL_S)

    def _publish(self, key: str, payload: bytes) -> None:
        self._bus.publish(key, payload)
        self.sent += 1
        self.sent_bytes += len(payload)

    def _receive(self, packets: list[Packet]) -> None:
        for key, payload in packets:
            try:
                setpoint = messages.decode(messages.Setpoint, payload, self._epoch)
                if setpoint.sender != self._commander.get(key):
                    raise messages.Rejected("sender", f"MAV {setpoint.sender} commands at {key}")
            except messages.Rejected as why:
                self.rejected += 1
                if key not in self._complained:
                    self._complained.add(key)
                    log.warning("rejected a message at %s (further ones are only counted): %s", key, why)
                continue
            self.received += 1
            if setpoint.stamp_ns == self._answered_stamp_ns:
                self._unanswered.discard(setpoint.sender)
            if self._newest_ns[setpoint.sender] < setpoint.stamp_ns <= self._answered_stamp_ns:
                self._newest_ns[setpoint.sender] = setpoint.stamp_ns
                self._commanded[setpoint.sender] = setpoint

    def _survey(self, mav: int, survey: Survey) -> messages.Survey:
        """What this MAV is told: every odometry frame in its own, with noise; its own needs none."""
        frames = self._motion.pose_world_odom
        sigmas = np.array([survey.position_sigma_m] * 3 + [survey.yaw_sigma_rad])
        noise = sigmas * generator(self._fleet.seed, f"survey/{mav}").standard_normal(frames.shape)
        poses = relative_pose(frames[mav - 1], frames) + noise
        poses[mav - 1] = 0
        header = (messages.VERSION, self._epoch, SENDER, 0, 0)
        return messages.Survey(*header, poses.tobytes(), survey.position_sigma_m, survey.yaw_sigma_rad)

    def _final_status(self, header: tuple[int, int, int, int, int]) -> messages.Status:
        """Counts itself among the messages, but, as those of the agents, not among the bytes."""
        return messages.Status(
            *header,
            sent=self.sent + 1,
            sent_bytes=self.sent_bytes,
            received=self.received,
            rejected=self.rejected,
            late=0,
            duplicate=0,
            tick_us=self._tick_us,
            station_us=(),
            late_ticks=self.late_ticks,
            final=True,
        )


def _motion(config: WorldConfig, fleet: Fleet) -> Motion:
    if config.flights:
        return RecordedFlights(config.flights, config.flights_dir, fleet, config.random_window)
    from world.commanded import CommandedFlight  # here, because recorded flights need no MuJoCo
    from world.simulated import SimulatedFlight

    return CommandedFlight(config, fleet) if config.commanded else SimulatedFlight(config, fleet)
