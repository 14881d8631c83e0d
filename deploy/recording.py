"""What happened in a run? The recorded messages as arrays by tick and MAV; what is missing is NaN.

Index k is the tick, i the agent (the MAV with number i + 1), j whom it is about.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface import messages, topics
from agent.interface.bus import Packet
from agent.interface.fleet import Fleet
from agent.interface.frames import Array, relative_pose, yaw_of
from agent.interface.messages import floats, read_spherical

UPPER = np.triu_indices(4)
UNKNOWN = 255  # no estimate of that tick
GONE = -1  # no incarnation: killed, stopped or not yet there


@dataclass(frozen=True)
class Survey:
    """What an agent was told at the start about where every odometry frame began."""

    poses: Array  # (N, 4) in its own odometry frame
    position_sigma_m: float
    yaw_sigma_rad: float


class Beliefs(NamedTuple):
    """What all agents said, or would have said, where everybody is."""

    states: npt.NDArray[np.uint8]  # (K, N, N) index into messages.STATES, or UNKNOWN
    estimates: Array  # (K, N, N, 4) pose of j in i's odometry frame, which drifts
    starts: Array  # (K, N, 4) where i's odometry began, in the same frame

    @staticmethod
    def none(ticks: int, mavs: int) -> "Beliefs":
        states = np.full((ticks, mavs, mavs), UNKNOWN, np.uint8)
        return Beliefs(states, np.full((ticks, mavs, mavs, 4), np.nan), np.full((ticks, mavs, 4), np.nan))

    def until(self, tick: int) -> "Beliefs":
        return Beliefs(self.states[:tick], self.estimates[:tick], self.starts[:tick])

    @property
    def absolute(self) -> Array:
        """(K, N, N, 4) pose of j in the frame that stays where i's odometry began."""
        return relative_pose(self.starts[:, :, None], self.estimates)


class Arrival(NamedTuple):
    """What reached an agent from a peer."""

    sender: int  # MAV number
    topic: str  # one of messages.AIR
    tick: int  # at which it was measured


class Intents(NamedTuple):
    """What each MAV said that it was about to do; -1 where it said nothing."""

    phase: npt.NDArray[np.int64]  # (K, N) index into PHASES
    formation: npt.NDArray[np.int64]  # (K, N)
    place: npt.NDArray[np.int64]  # (K, N)


class ProcessFault(NamedTuple):
    tick: int  # before which it happened
    mav: int  # MAV number
    do: str


@dataclass(frozen=True)
class Recording:
    fleet: Fleet
    time_s: Array  # (K,) simulated
    truth: Array  # (K, N, 7) in world: x y z m, quaternion x y z w
    vio: Array  # (K, N, 7) in each MAV's odometry frame: the same, as its driver gave it
    odometry: Array  # (K, N, 4) in each MAV's odometry frame: x y z m, yaw rad, as it told its peers
    wanted: Array  # (K, N, 3) m, in each MAV's odometry frame: the place that it was commanded to be at
    intents: Intents
    beliefs: Beliefs
    covariances: Array  # (K, N, N, 4, 4) of the estimates
    innovations: Array  # (K, N, 2) how many detections were associated, how many of them inside their 95 % gate
    neighbours: npt.NDArray[np.uint8]  # (K, N, N) index into messages.NEIGHBOURS: whether i finds j there
    tick_us: Array  # (K, N) what the tick cost agent i, wall time
    station_us: list[tuple[int, ...]]  # what the station updates of each recorded agent's tick cost
    detections: dict[tuple[int, int], Array]  # (tick, MAV number) -> (M, 3) range m, azimuth rad, elevation rad
    labels: dict[tuple[int, int], npt.NDArray[np.int64]]  # (tick, MAV number) -> (M,) MAV number, 0 a false detection
    surveys: dict[int, Survey]  # by MAV number
    registrations: dict[int, messages.Registration]  # the last one of each agent that sent any, by MAV number
    statuses: dict[int, messages.Status]  # the last one of each sender; 0 is the world
    former_statuses: list[messages.Status]  # the last ones of processes that were started anew afterwards
    incarnations: npt.NDArray[np.int64]  # (K, N) how often each MAV has been started anew; GONE: it does not take part
    arrivals: dict[tuple[int, int], list[Arrival]]  # (tick, MAV number) -> in order; empty if no fault was injected
    dropped: npt.NDArray[np.int64]  # (N, N) how many packets to i from j the faults lost
    process_faults: list[ProcessFault]
    touched: set[tuple[int, int]]  # pairs of MAV numbers, ascending, that were in contact at any time
    rejected: dict[str, int] = field(default_factory=dict)  # packets that are not messages of the run, by reason

    @property
    def ticks(self) -> int:
        return len(self.time_s)

    @property
    def true_poses(self) -> Array:
        """(K, N, 4) x y z m, yaw rad in world."""
        return pose_of(self.truth)


def pose_of(full: Array) -> Array:
    """(..., 7) position and quaternion as (..., 4) x y z m, yaw rad."""
    return np.concatenate([full[..., :3], yaw_of(full[..., 3:])[..., None]], axis=-1)


def assemble(packets: Iterable[Packet], fleet: Fleet, epoch: int) -> Recording:
    """The recording that these packets make; undecodable ones are counted, absent ones leave NaN."""
    builder = _Builder(fleet, epoch)
    for packet in packets:
        try:
            builder.add(packet)
        except messages.Rejected as error:
            builder.reject(str(error).partition(":")[0])
    return builder.recording()


class _Builder:
    """Fills the arrays, message by message."""

    def __init__(self, fleet: Fleet, epoch: int) -> None:
        self.fleet, self.epoch, self.end = fleet, epoch, 0
        K, N = fleet.ticks + 1, fleet.mavs  # whether the last stamp is the duration or the tick before does not matter
        self.truth = np.full((K, N, 7), np.nan)
        self.vio = np.full((K, N, 7), np.nan)
        self.odometry = np.full((K, N, 4), np.nan)
        self.wanted = np.full((K, N, 3), np.nan)
        self.intents = Intents(*np.full((3, K, N), -1, np.int64))
        self.beliefs = Beliefs.none(K, N)
        self.covariances = np.full((K, N, N, 4, 4), np.nan)
        self.innovations = np.full((K, N, 2), np.nan)
        self.neighbours = np.zeros((K, N, N), np.uint8)
        self.tick_us = np.full((K, N), np.nan)
        self.station_us: list[tuple[int, ...]] = []
        self.detections: dict[tuple[int, int], Array] = {}
        self.labels: dict[tuple[int, int], npt.NDArray[np.int64]] = {}
        self.surveys: dict[int, Survey] = {}
        self.registrations: dict[int, messages.Registration] = {}
        self.statuses: dict[int, messages.Status] = {}
        self.former_statuses: list[messages.Status] = []
        self.rolls: dict[int, messages.Roll] = {}  # by the tick from which on it holds
        self.arrivals: dict[tuple[int, int], list[Arrival]] = {}
        self.dropped = np.zeros((N, N), np.int64)
        self.process_faults: list[ProcessFault] = []
        self.touched: set[tuple[int, int]] = set()
        self.rejected: dict[str, int] = {}

    def add(self, packet: Packet) -> None:
        topic, mav = topics.parse(packet.key)
        if topic in (topics.SIGHTINGS, topics.END):
            return  # recorded, but no metric needs them
        message = messages.decode(topic.kind, packet.payload, self.epoch)
        if mav not in self.fleet.ids and topic is not topics.STATUS:
            raise messages.Rejected("mav", f"{mav}, this run has 1 to {self.fleet.mavs}")
        if isinstance(message, messages.Status):
            self._add_status(message)
        elif isinstance(message, messages.Survey):
            poses = floats(message.poses).reshape(-1, 4)
            self._expect(len(poses) == self.fleet.mavs, f"a survey of {len(poses)} MAVs")
            self.surveys[mav] = Survey(poses, message.position_sigma_m, message.yaw_sigma_rad)
        else:
            self._add_sample(message, self._tick(message.stamp_ns), mav)

    def _add_sample(self, message: messages.Header, k: int, mav: int) -> None:
        i, N = mav - 1, self.fleet.mavs
        match message:
            case messages.Truth():
                self.truth[k, i] = np.concatenate([floats(message.position), floats(message.quaternion)])
                self.end = max(self.end, k + 1)
            case messages.Vio():
                self.vio[k, i] = np.concatenate([floats(message.position), floats(message.quaternion)])
            case messages.Odometry():
                self.odometry[k, i] = floats(message.pose)
                if (said := message.intent) is not None:
                    for part, value in zip(self.intents, (said.phase, said.formation, said.place), strict=True):
                        part[k, i] = value
            case messages.Setpoint():
                self.wanted[k, i] = floats(message.position)
            case messages.Detections():
                self.detections[k, mav] = read_spherical(message.spherical)
            case messages.Labels():
                self.labels[k, mav] = np.frombuffer(message.targets, np.uint8).astype(np.int64)
            case messages.Estimate():
                self._expect(len(message.states) == N, f"an estimate of {len(message.states)} MAVs")
                self.beliefs.states[k, i] = np.frombuffer(message.states, np.uint8)
                self.beliefs.estimates[k, i] = floats(message.poses).reshape(N, 4)
                self.beliefs.starts[k, i] = floats(message.start)
                upper = np.frombuffer(message.covariances, "<f4").reshape(N, 10)
                self.covariances[k, i][:, UPPER[0], UPPER[1]] = upper
                self.covariances[k, i][:, UPPER[1], UPPER[0]] = upper
                self.innovations[k, i] = message.innovations, message.innovations_inside
            case messages.Registration():
                self._expect(len(message.reasons) == N, f"a registration of {len(message.reasons)} MAVs")
                before = self.registrations.get(mav)
                if before is None or (message.stamp_ns, message.seq) > (before.stamp_ns, before.seq):
                    self.registrations[mav] = message
            case messages.Roll():
                self._expect(all(each in self.fleet.ids for each in message.mavs), f"a roll of {list(message.mavs)}")
                self.rolls[k] = message
            case messages.Arrivals():
                self._add_arrivals(message, k, mav)
            case messages.ProcessFault():
                self.process_faults.append(ProcessFault(k, mav, message.do))
            case messages.Contact():
                self._expect(all(each in self.fleet.ids for each in message.others), f"contact with {message.others!r}")
                self.touched.update((min(mav, other), max(mav, other)) for other in message.others)

    def _add_arrivals(self, message: messages.Arrivals, k: int, mav: int) -> None:
        self._expect(len(message.dropped) == self.fleet.mavs, f"arrivals from {len(message.dropped)} MAVs")
        self._expect(all(sender in self.fleet.ids for sender in message.senders), "arrivals from other MAVs")
        self.dropped[mav - 1] += message.dropped
        stamps_ns = np.frombuffer(message.stamps, "<i8").tolist()
        self.arrivals[k, mav] = [
            Arrival(sender, messages.AIR[topic], self._tick(stamp_ns))
            for sender, topic, stamp_ns in zip(message.senders, message.topics, stamps_ns, strict=True)
        ]

    def _add_status(self, status: messages.Status) -> None:
        before = self.statuses.get(status.sender)
        if before is not None and before.stamp_ns < status.stamp_ns and before.seq >= status.seq:
            self.former_statuses.append(before)  # it counts from zero again
        if before is None or (status.stamp_ns, status.seq) > (before.stamp_ns, before.seq):
            self.statuses[status.sender] = status
        if status.sender in self.fleet.ids and not status.final:
            at = self._tick(status.stamp_ns), status.sender - 1
            self.tick_us[at] = status.tick_us
            if len(status.neighbours) == self.fleet.mavs:
                self.neighbours[at] = np.frombuffer(status.neighbours, np.uint8)
            if status.station_us:
                self.station_us.append(status.station_us)

    def _tick(self, stamp_ns: int) -> int:
        k = round(stamp_ns * self.fleet.rate_hz / 1e9)
        self._expect(0 <= k <= self.fleet.ticks, f"a message of {stamp_ns} ns in {self.fleet.duration_s} s")
        return k

    def _expect(self, holds: bool, found: str) -> None:
        if not holds:
            raise messages.Rejected("unexpected", found)

    def _incarnations(self) -> npt.NDArray[np.int64]:
        found = np.zeros((self.fleet.ticks + 1, self.fleet.mavs), np.int64)
        for k, roll in sorted(self.rolls.items()):
            found[k:] = GONE
            found[k:, [mav - 1 for mav in roll.mavs]] = roll.incarnations
        return found

    def reject(self, reason: str) -> None:
        self.rejected[reason] = self.rejected.get(reason, 0) + 1

    def recording(self) -> Recording:
        K = self.end  # the world decides how long the run was
        return Recording(
            fleet=self.fleet,
            time_s=np.array([self.fleet.stamp_ns(k) / 1e9 for k in range(K)]),
            truth=self.truth[:K],
            vio=self.vio[:K],
            odometry=self.odometry[:K],
            wanted=self.wanted[:K],
            intents=Intents(*(part[:K] for part in self.intents)),
            beliefs=self.beliefs.until(K),
            covariances=self.covariances[:K],
            innovations=self.innovations[:K],
            neighbours=self.neighbours[:K],
            tick_us=self.tick_us[:K],
            station_us=self.station_us,
            detections=self.detections,
            labels=self.labels,
            surveys=self.surveys,
            registrations=self.registrations,
            statuses=self.statuses,
            former_statuses=self.former_statuses,
            incarnations=self._incarnations()[:K],
            arrivals=self.arrivals,
            dropped=self.dropped,
            process_faults=sorted(self.process_faults),
            touched=self.touched,
            rejected=self.rejected,
        )
