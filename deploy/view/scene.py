"""What is there to be seen at a tick? Where all are and are believed to be, what was detected, rivals and links.

All is in the world's frame: an agent's beliefs are laid where its odometry truly began, which no agent knows. Where
there is no truth, as with real MAVs, each agent's beliefs stay in the frame that began where its odometry did.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface import messages, topics
from agent.interface.bus import Packet
from agent.interface.fleet import Fleet
from agent.interface.frames import Array, compose, direction, inverse, relative_pose, rotate_z
from agent.interface.messages import LOCALISED, floats, read_spherical
from agent.interface.sensors import Detector
from agent.interface.tables import parse_table
from deploy import metrics
from deploy.experiment import Experiment, from_text
from deploy.log import read_log
from deploy.peek import peek
from deploy.recording import UPPER, pose_of

OPEN = 3  # ticks that are still waited for: their messages come in any order
SHOWN = {
    topic.name
    for topic in (
        topics.TRUTH, topics.ODOMETRY, topics.DETECTIONS, topics.ESTIMATE, topics.REGISTRATION, topics.STATUS,
        topics.ROLL, topics.ARRIVALS,
    )
}  # fmt: skip
Tick = dict[tuple[str, int], bytes]  # payloads by topic and MAV: most are never looked at


class Belief(NamedTuple):
    """What one agent believes."""

    poses: Array  # (N, 4) x y z m, yaw rad; NaN of whom it has not localised
    covariances: Array  # (N, 3, 3) m^2, of the positions
    states: npt.NDArray[np.uint8]  # (N,) index into messages.STATES
    detected: Array  # (M, 3) m, where its detections lie
    explained: Array  # (M,) 0 to 1, how far whom it has localised explains each of them
    rivals: Array  # (H, N, 4) the joint hypotheses that compete; NaN where one says nothing of a MAV
    rival_weights: Array  # (H,)
    error_m: float  # root mean square of the relative positions of whom it has localised; NaN: unknown
    tick_ms: float


class Scene(NamedTuple):
    time_s: float  # simulated
    truth: Array  # (N, 4)
    beliefs: dict[int, Belief]  # by the agents' MAV numbers
    ages_s: Array  # (N, N) how old the newest odometry is that MAV i + 1 has of j + 1; NaN: it has none


class Stage:
    """Makes scenes of a run's messages, in the order in which they were sent or recorded.

    Args:
        detector: what the agents believe of their detectors.
        faults: whether the network had any: then what arrived is what the journal says.
    """

    def __init__(self, fleet: Fleet, epoch: int, detector: Detector, faults: bool) -> None:
        self._fleet, self._epoch, self._detector, self._faults = fleet, epoch, detector, faults
        self._open: dict[int, Tick] = {}
        self._closed = -1
        self._origins = np.full((fleet.mavs, 4), np.nan)  # of the odometry frames, in world
        self._lives = np.zeros(fleet.mavs, int)
        self._newest = np.full((fleet.mavs, fleet.mavs), np.nan)  # tick of the newest that i has from j

    def see(self, packet: Packet, show: bool = True) -> list[Scene]:
        """The scenes that are complete now, oldest first; none if they are not to be shown, which costs much less."""
        try:
            topic, mav = topics.parse(packet.key)
        except messages.Rejected:
            return []
        header = peek(packet.payload)
        if topic.name not in SHOWN or mav not in self._fleet.ids or header is None or header.epoch != self._epoch:
            return []
        k = round(header.stamp_ns * self._fleet.rate_hz / 1e9)
        if not self._closed < k <= self._fleet.ticks:
            return []
        if k not in self._open:
            self._open[k] = {}
        self._open[k][topic.name, mav] = packet.payload
        if len(self._open) <= OPEN:
            return []
        ripe = [k for k in sorted(self._open) if k <= max(self._open) - OPEN]
        closed = [(k, self._close(k)) for k in ripe]
        return [self._scene(k, tick) for k, tick in closed if show]

    def rest(self) -> list[Scene]:
        """The scenes that are left when nothing more will come."""
        return [self._scene(k, self._close(k)) for k in sorted(self._open)]

    def _message(self, kind: type[messages.M], topic: topics.Topic, tick: Tick, mav: int) -> messages.M | None:
        payload = tick.get((topic.name, mav))
        try:
            return None if payload is None else messages.decode(kind, payload, self._epoch)
        except messages.Rejected:
            return None

    def _close(self, k: int) -> Tick:
        """What is kept of a tick for the next ones."""
        tick, self._closed = self._open.pop(k), k
        for mav in self._fleet.ids:
            roll = self._message(messages.Roll, topics.ROLL, tick, mav)
            if roll is not None:
                self._begin_anew(roll)
        for i in np.flatnonzero(np.isnan(self._origins[:, 0])).tolist():
            self._origins[i] = compose(self._truth(tick, i), inverse(self._odometry(tick, i)))
        for i, mav in enumerate(self._fleet.ids):
            if not self._faults:
                if (topics.ODOMETRY.name, mav) in tick:
                    self._newest[:, i] = k
            elif (found := self._message(messages.Arrivals, topics.ARRIVALS, tick, mav)) is not None:
                senders, stamps = np.frombuffer(found.senders, np.uint8), np.frombuffer(found.stamps, "<i8")
                known = (senders >= 1) & (senders <= self._fleet.mavs)
                np.fmax.at(self._newest[i], senders[known] - 1, np.round(stamps[known] * self._fleet.rate_hz / 1e9))
        return tick

    def _begin_anew(self, roll: messages.Roll) -> None:
        """Whoever was started anew has an odometry frame of its own."""
        for mav, life in zip(roll.mavs, roll.incarnations, strict=True):
            if mav in self._fleet.ids and life > self._lives[mav - 1]:
                self._lives[mav - 1], self._origins[mav - 1] = life, np.nan

    def _truth(self, tick: Tick, i: int) -> Array:
        found = self._message(messages.Truth, topics.TRUTH, tick, i + 1)
        if found is None:
            return np.full(4, np.nan)
        return pose_of(np.concatenate([floats(found.position), floats(found.quaternion)]))

    def _odometry(self, tick: Tick, i: int) -> Array:
        found = self._message(messages.Odometry, topics.ODOMETRY, tick, i + 1)
        return np.full(4, np.nan) if found is None else floats(found.pose)

    def _scene(self, k: int, tick: Tick) -> Scene:
        truth = np.array([self._truth(tick, i) for i in range(self._fleet.mavs)])
        beliefs: dict[int, Belief] = {}
        for mav in self._fleet.ids:
            estimate = self._message(messages.Estimate, topics.ESTIMATE, tick, mav)
            if estimate is not None and len(estimate.states) == self._fleet.mavs:
                beliefs[mav] = self._belief(tick, mav - 1, estimate, truth)
        return Scene(self._fleet.stamp_ns(k) / 1e9, truth, beliefs, (k - self._newest) / self._fleet.rate_hz)

    def _belief(self, tick: Tick, i: int, estimate: messages.Estimate, truth: Array) -> Belief:
        N = self._fleet.mavs
        states = np.frombuffer(estimate.states, np.uint8)
        believed = np.where((states == LOCALISED)[:, None], floats(estimate.poses).reshape(N, 4), np.nan)
        believed[i] = floats(estimate.poses).reshape(N, 4)[i]  # by its own odometry, always
        covariances = np.zeros((N, 4, 4))
        covariances[:, UPPER[0], UPPER[1]] = np.frombuffer(estimate.covariances, "<f4").reshape(N, 10)
        covariances[:, UPPER[1], UPPER[0]] = covariances[:, UPPER[0], UPPER[1]]
        origin = self._origins[i] if np.isfinite(self._origins[i]).all() else np.zeros(4)
        frame = compose(origin, inverse(floats(estimate.start)))  # of its odometry as it has drifted until now
        placed = turned(frame[3], covariances[:, :3, :3])
        weights, rivals = self._rivals(self._message(messages.Registration, topics.REGISTRATION, tick, i + 1))
        seen = self._message(messages.Detections, topics.DETECTIONS, tick, i + 1)
        spherical = np.zeros((0, 3)) if seen is None else read_spherical(seen.spherical)
        vectors = spherical[:, :1] * direction(spherical[:, 1], spherical[:, 2])
        relative = relative_pose(believed[i], believed)
        sure = np.isfinite(relative[:, 0]) & (np.arange(N) != i)
        own = turned(-believed[i, 3], covariances[:, :3, :3])
        true = relative_pose(truth[i], truth)
        status = self._message(messages.Status, topics.STATUS, tick, i + 1)
        return Belief(
            poses=compose(frame, believed),
            covariances=placed,
            states=states,
            detected=compose(frame, compose(believed[i], np.column_stack([vectors, np.zeros(len(vectors))])))[:, :3],
            explained=explained(vectors, relative[sure, :3], own[sure], self._detector),
            rivals=compose(frame, rivals),
            rival_weights=weights,
            error_m=metrics.rms(np.linalg.norm((relative - true)[sure, :3], axis=-1)),
            tick_ms=np.nan if status is None or status.final else status.tick_us / 1000,
        )

    def _rivals(self, registration: messages.Registration | None) -> tuple[Array, Array]:
        N = self._fleet.mavs
        if registration is None or len(registration.reasons) != N:
            return np.zeros(0), np.zeros((0, N, 4))
        placed = np.frombuffer(registration.placed, np.uint8).reshape(-1, N) > 0
        poses = np.frombuffer(registration.poses, "<f4").reshape(-1, N, 4).astype(float)
        return floats(registration.weights), np.where(placed[..., None], poses, np.nan)


def turned(yaw: float | Array, covariances: Array) -> Array:
    """(..., 3, 3) of positions, in axes turned about the vertical by so many rad."""
    half = rotate_z(yaw, covariances.swapaxes(-1, -2))  # rows are vectors
    return rotate_z(yaw, half.swapaxes(-1, -2))


def explained(vectors: Array, places: Array, covariances: Array, detector: Detector) -> Array:
    """(M,) how far MAVs that are believed to be there explain each detection, beside clutter.

    Each detection on its own: the filter's weights are joint ones, of whole sets.

    Args:
        vectors: (M, 3) m, the detections, in the body frame.
        places: (L, 3) m, where MAVs are believed to be, in the same frame.
        covariances: (L, 3, 3) m^2, of these beliefs.
    """
    if not len(vectors) or not len(places):
        return np.zeros(len(vectors))
    distance = np.linalg.norm(places, axis=1)
    along = (places / distance[:, None])[:, :, None] * (places / distance[:, None])[:, None, :]
    across = (detector.bearing_sigma_rad * distance)[:, None, None] ** 2 * (np.eye(3) - along)
    S = covariances + detector.range_sigma_m(distance)[:, None, None] ** 2 * along + across
    nu = vectors[:, None] - places
    squared = np.einsum("mli,lij,mlj->ml", nu, np.linalg.inv(S), nu)
    likelihood = detector.P_D * np.exp(-squared / 2) / np.sqrt((2 * np.pi) ** 3 * np.linalg.det(S))
    total = likelihood.sum(axis=1)
    return np.asarray(total / (total + detector.clutter_density))


def stage_of(experiment: Experiment, epoch: int) -> Stage:
    """The stage for the messages of this run."""
    detector = parse_table(Detector, experiment.agent.get("detector", {}), "agent.detector")
    return Stage(experiment.fleet, epoch, detector, experiment.faults.present)


def scenes(folder: Path) -> Iterator[Scene]:
    """All scenes of a recorded run.

    Raises:
        BadLog: there is no log of a run in the folder.
    """
    log = read_log(folder / "log.mcap")
    stage = stage_of(from_text(log.origin.experiment), log.origin.epoch)
    for packet in log.packets:
        yield from stage.see(packet)
    yield from stage.rest()
