"""What does an agent do all day? It senses, shares, waits for its peers, estimates, commands.

A tick opens with the MAV's own VIO reading and detection set, which are sent to the peers as they are (raw data, never
estimates, so nothing is counted twice). It closes when every peer's data of the same time is here: in lockstep however
long that takes, unless the bus says that nothing more will come, in real time after a short wait.
"""

import logging
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from agent.config import AgentConfig
from agent.controller.hold import Hold
from agent.controller.surroundings import Surroundings
from agent.controller.trajectory import Sample
from agent.estimator.beliefs import Beliefs
from agent.estimator.joint_update import DetectionSet
from agent.interface import clock, messages, topics
from agent.interface.bus import Bus, Packet
from agent.interface.bus import Inbox as BusInbox
from agent.interface.fleet import Fleet
from agent.interface.frames import Array
from agent.interface.presence import Presence
from agent.interface.topics import Topic
from agent.localiser import Localiser
from agent.registration.reasons import Situation
from agent.sensing import detections, vio
from agent.sensing.inbox import AT_ONCE, Inbox
from agent.sensing.liveness import Liveness
from agent.sensing.neighbours import Neighbours
from agent.sensing.own import OwnSensors
from agent.sensing.queues import SeveralInboxes

if TYPE_CHECKING:
    from agent.controller.pilot import Pilot

log = logging.getLogger("agent")

BEHIND = 3  # real time: ticks that may wait; one that was stopped, or is too slow, goes on from the newest
UNHURRIED = 0.05  # real time: share of the period after which a tick that begins is late
SENSOR_POLL_S = 0.002  # real time: between looks for its own sensors

_UPPER = np.ravel_multi_index(np.triu_indices(4), (4, 4))  # of a flattened covariance


class Agent:
    """MAV `mav` of the fleet on this bus: `run` it, or `advance` it from outside."""

    def __init__(self, config: AgentConfig, fleet: Fleet, mav: int, epoch: int, bus: Bus) -> None:
        self._fleet, self._mav, self._epoch, self._bus = fleet, mav, epoch, bus
        self._patience_s = config.wait_for_peers_s if fleet.realtime else None
        self._localiser = Localiser(config, fleet, mav)
        self._placed_sigma_m = config.localised_sigma_m
        self._pilot: Pilot | None = None
        if config.mission is not None:
            from agent.controller import pilot  # here, because only a mission needs an optimiser

            self._pilot = pilot.Pilot(config.mission, mav)
        self._hold = Hold()
        self._inbox = Inbox(mav, fleet.mavs, epoch)
        self._neighbours = Neighbours(fleet.mavs, fleet.rate_hz, config.lag_ticks(fleet.rate_hz))
        at_least_s = 3 / fleet.rate_hz
        stale_after_s, gone_after_s = max(at_least_s, config.stale_after_s), max(at_least_s, config.gone_after_s)
        self._liveness = Liveness(mav, fleet.mavs, stale_after_s, gone_after_s)
        self._presence: Presence | None = None
        self._stations = [mav, *(other for other in fleet.ids if other != mav)]  # itself first
        self._own, self._behind = OwnSensors(), BEHIND if fleet.realtime else math.inf
        self._unhurried_s = UNHURRIED / fleet.rate_hz if fleet.realtime else math.inf
        self._hold_after_s, self._holding = max(at_least_s, config.hold_after_s), False
        self._sensed_s = clock.now_s()  # when its own sensors last began a tick
        self._newest_ns = 0  # the stamp of that
        self._open_ns: int | None = None  # the tick that waits for peers
        self._deadline_s = 0.0
        self._ended_ns: int | None = None
        self._registering = True
        self.done = False
        self._seq: dict[Topic, int] = {}
        self._sent = self._sent_bytes = 0
        if fleet.realtime:  # a queue for each, so that who floods one loses only what is his
            own = [topics.key(topic, mav) for topic in (topics.VIO, topics.SIGHTINGS, topics.SURVEY, topics.END)]
            self._sensors: BusInbox = SeveralInboxes([bus.subscribe(key, AT_ONCE) for key in own], SENSOR_POLL_S)
            peers = [f"air/{other}/*" for other in fleet.ids if other != mav]
            self._air: BusInbox = SeveralInboxes([bus.subscribe(pattern, AT_ONCE) for pattern in peers])
        else:
            self._sensors = bus.subscribe(f"sensor/{mav}/*")
            self._air = bus.subscribe("air/*/*")

    def run(self, presence: Presence | None = None) -> None:
        """Flies until the end of the run is announced.

        Raises:
            AlreadyHere: another agent has the same number, and the better claim to it.
        """
        self._presence, self._sensed_s = presence, clock.now_s()
        while not self.done:
            self.advance()
            if self.done:
                return
            if presence is not None:
                presence.look()
            if self._open_ns is None:
                self._await_sensors()
            elif self._patience_s is None:
                packets = self._air.wait(None)
                self._receive(packets)
                if not packets:
                    self.advance(all_here=True)
            else:
                self._receive(self._air.wait(max(0.0, self._deadline_s - clock.now_s())))

    def advance(self, all_here: bool = False) -> None:
        """Takes in what has arrived and does all that can be done now.

        Args:
            all_here: nothing more will come for the open tick.
        """
        self._receive(self._sensors.drain())
        self._receive(self._air.drain())
        while self._open_next() or self._close(all_here):
            pass
        if self._open_ns is None and self._ended_ns is not None and not self.done:
            self._publish_status(self._ended_ns, 0, (), final=True)
            self.done = True

    def _await_sensors(self) -> None:
        """In lockstep for ever: simulated time stands still as well. In real time it holds, and says so, meanwhile."""
        self._receive(self._sensors.wait(self._hold_after_s if self._patience_s is not None else None))
        silent_s = clock.now_s() - self._sensed_s
        if self._patience_s is not None and not self._holding and silent_s > self._hold_after_s:
            self._holding = True
            log.warning("nothing from its own sensors for %.1f s: holding", silent_s)
            self._publish_status(self._newest_ns, 0, ())

    def _receive(self, packets: Iterable[Packet]) -> None:
        for packet in packets:
            received = self._inbox.read(packet)
            if received is None:
                continue
            message = received.message
            match message:
                case messages.Odometry():
                    self._liveness.heard(received.mav, message.stamp_ns)
                    pose = messages.floats(message.pose)
                    if self._neighbours.restarted(message.stamp_ns, received.mav, message.seq):
                        self._localiser.begun_anew(self._neighbours.tick_of(message.stamp_ns), received.mav)
                    late = self._neighbours.put(message.stamp_ns, received.mav, odometry=pose, intent=message.intent)
                    if late is not None:
                        self._localiser.late(late, received.mav, odometry=pose)
                case messages.Detections():
                    spherical = messages.read_spherical(message.spherical)
                    late = self._neighbours.put(message.stamp_ns, received.mav, detections=spherical)
                    if late is not None:
                        self._localiser.late(late, received.mav, spherical=spherical)
                case messages.Vio():
                    self._own.put_vio(message.stamp_ns, vio.read(message))
                case messages.Sightings():
                    self._own.put_sightings(message)
                case messages.Survey():
                    frames = messages.floats(message.poses).reshape(-1, 4)
                    self._localiser.start(frames, message.position_sigma_m, message.yaw_sigma_rad)
                case messages.End():
                    self._ended_ns = message.stamp_ns

    def _open_next(self) -> bool:
        """Begins the oldest tick whose VIO reading and detection set are both here, and shares them."""
        if self._open_ns is not None:
            return False
        reading = self._own.take(self._behind)
        while reading is not None and not self._neighbours.expects(reading.stamp_ns):
            reading = self._own.take(self._behind)  # not what is over, or off the beat
        if reading is None:
            return False
        stamp_ns, levelled = reading.stamp_ns, reading.levelled
        if self._holding:
            self._holding = False
            log.warning("its own sensors are back after %.1f s", clock.now_s() - self._sensed_s)
        self._sensed_s, self._newest_ns = clock.now_s(), stamp_ns
        self._inbox.next_tick()
        spherical = detections.levelled(reading.sightings, levelled.tilt)
        block = messages.spherical_block(spherical)
        about_to = () if self._pilot is None else (self._pilot.intent,)
        self._publish(topics.ODOMETRY, messages.Odometry, stamp_ns, levelled.pose.tobytes(), *about_to)
        self._publish(topics.DETECTIONS, messages.Detections, stamp_ns, block)
        self._neighbours.go_on_at(stamp_ns)
        # Its own data as its peers receive it, so that all agents estimate from the same numbers.
        self._neighbours.put(stamp_ns, self._mav, odometry=levelled.pose, detections=messages.read_spherical(block))
        self._open_ns = stamp_ns
        self._deadline_s = clock.now_s() + (self._patience_s or 0.0)
        return True

    def _close(self, all_here: bool) -> bool:
        """Estimates the open tick if its data is complete, nothing more will come, or its time is up."""
        stamp_ns = self._open_ns
        if stamp_ns is None:
            return False
        number = self._neighbours.tick_of(stamp_ns)
        if not (all_here or self._neighbours.complete(number)) and (
            self._patience_s is None or clock.now_s() < self._deadline_s
        ):
            return False
        self._open_ns = None
        self._liveness.look(stamp_ns, None if self._presence is None else self._presence.has_mav)
        tick = self._neighbours.take(number)
        began_us = clock.now_us()
        sets = [
            DetectionSet(station, tick.detections[station])
            for station in self._stations
            if station in tick.detections and station in tick.odometry
        ]
        hurried = clock.now_s() - self._sensed_s > self._unhurried_s
        beliefs, situation = self._localiser.tick(number, tick.odometry, sets, hurried)
        tick_us = clock.now_us() - began_us
        self._publish_registration(stamp_ns, situation)
        self._publish_estimate(stamp_ns, beliefs)
        self._publish_status(stamp_ns, tick_us, (self._localiser.station_us,))
        self._publish_command(stamp_ns, self._wanted(stamp_ns, tick.odometry[self._mav], beliefs))
        return True

    def _wanted(self, stamp_ns: int, odometry: Array, beliefs: Beliefs) -> Sample:
        """What the controller wants to be flown, in the odometry frame."""
        if self._pilot is None:
            return self._hold.fly(odometry)
        sigmas = np.sqrt(beliefs.covariances[:, range(3), range(3)].max(axis=1))
        return self._pilot.fly(
            Surroundings(
                stamp_ns,
                odometry,
                beliefs.poses,
                sigmas,
                self._localiser.frames(),
                beliefs.states == messages.LOCALISED,
                sigmas < self._placed_sigma_m,
                np.array([state != messages.GONE for state in self._liveness.states]),
                self._neighbours.intents(),
            )
        )

    def _publish_registration(self, stamp_ns: int, situation: Situation | None) -> None:
        """While somebody is not localised, and once more when everybody is."""
        if situation is None and not self._registering:
            return
        self._registering = situation is not None
        if situation is None:
            fields: tuple[object, ...] = (("",) * self._fleet.mavs, b"", b"", b"")
        else:
            placed = situation.placed.astype(np.uint8).tobytes()
            poses = situation.poses.astype("<f4").tobytes()
            fields = (situation.reasons, situation.weights.tobytes(), placed, poses)
        self._publish(topics.REGISTRATION, messages.Registration, stamp_ns, *fields)

    def _publish_estimate(self, stamp_ns: int, beliefs: Beliefs) -> None:
        covariances = beliefs.covariances.reshape(-1, 16).take(_UPPER, axis=1).astype("<f4")
        self._publish(
            topics.ESTIMATE,
            messages.Estimate,
            stamp_ns,
            beliefs.states.tobytes(),
            beliefs.poses.tobytes(),
            covariances.tobytes(),
            beliefs.start.tobytes(),
            beliefs.innovations,
            beliefs.innovations_inside,
        )

    def _publish_command(self, stamp_ns: int, wanted: Sample) -> None:
        blocks = [part.tobytes() for part in (wanted.position, wanted.velocity, wanted.acceleration)]
        self._publish(topics.COMMAND, messages.Setpoint, stamp_ns, *blocks, 0.0)

    def _publish_status(self, stamp_ns: int, tick_us: int, station_us: tuple[int, ...], final: bool = False) -> None:
        inbox, neighbours = self._inbox, self._neighbours
        self._publish(
            topics.STATUS,
            messages.Status,
            stamp_ns,
            self._sent + 1,  # this one included
            self._sent_bytes,
            inbox.received,
            inbox.rejected + neighbours.unbelieved,
            neighbours.late,
            neighbours.duplicate,
            tick_us,
            station_us,
            0,  # ticks are the world's
            final,
            bytes(self._liveness.states),
            self._holding,
        )

    def _publish(self, topic: Topic, kind: type[messages.Header], stamp_ns: int, *fields: object) -> None:
        seq = self._seq.get(topic, 0)
        self._seq[topic] = seq + 1
        header = (messages.VERSION, self._epoch, self._mav, seq, stamp_ns)
        payload = messages.encode_fields(kind, *header, *fields)
        self._bus.publish(topics.key(topic, self._mav), payload)
        self._sent += 1
        self._sent_bytes += len(payload)
