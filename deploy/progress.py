"""How is the run going? Per MAV the state of its estimate and its present error, from the messages that pass by.

Cheap: it keeps the newest payloads and decodes them only when it is asked.
"""

from collections import deque

import msgspec
import numpy as np

from agent.interface import messages, topics
from agent.interface.bus import Packet
from agent.interface.fleet import Fleet
from agent.interface.frames import Array, relative_pose
from agent.interface.messages import LOCALISED, SEARCHING, floats
from deploy import commits, metrics
from deploy.recording import pose_of

KEPT = 4  # truths of the last ticks: estimates lag


class MavProgress(msgspec.Struct, frozen=True):
    id: int
    state: str  # of the other MAV that it knows least about
    least_known: int | None  # which that is; None: all are localised, or it has said nothing yet
    reason: str  # why that one is not localised, in words; "" if none was given
    localised: int  # how many other MAVs it calls localised
    error_m: float | None  # root mean square, over those it calls localised, of their relative positions; None: unknown
    stale: tuple[int, ...] = ()  # neighbours of which it has heard nothing for some time
    gone: tuple[int, ...] = ()  # neighbours that are not there any more
    holding: bool = False  # its own sensors are silent
    lost: float | None = None  # share of what its sensors and its peers have sent since its start and it has not had
    tick_ms: float | None = None  # what its last tick cost


class Progress(msgspec.Struct, frozen=True):
    sim_s: float  # simulated time reached
    of_s: float
    mavs: tuple[MavProgress, ...]


class Watch:
    def __init__(self, fleet: Fleet, epoch: int) -> None:
        self._fleet, self._epoch = fleet, epoch
        self._truth_keys = {topics.key(topics.TRUTH, mav): mav for mav in fleet.ids}
        self._estimate_keys = {topics.key(topics.ESTIMATE, mav): mav for mav in fleet.ids}
        self._truths: dict[int, deque[bytes]] = {mav: deque(maxlen=KEPT) for mav in fleet.ids}
        self._estimates: dict[int, bytes] = {}
        self._registration_keys = {topics.key(topics.REGISTRATION, mav): mav for mav in fleet.ids}
        self._registrations: dict[int, bytes] = {}
        self._status_keys = {topics.key(topics.STATUS, mav): mav for mav in fleet.ids}
        self._statuses: dict[int, bytes] = {}

    def see(self, packet: Packet) -> None:
        if (mav := self._truth_keys.get(packet.key)) is not None:
            self._truths[mav].append(packet.payload)
        elif (mav := self._estimate_keys.get(packet.key)) is not None:
            self._estimates[mav] = packet.payload
        elif (mav := self._registration_keys.get(packet.key)) is not None:
            self._registrations[mav] = packet.payload
        elif (mav := self._status_keys.get(packet.key)) is not None:
            self._statuses[mav] = packet.payload

    def now(self) -> Progress:
        truths: dict[int, Array] = {}  # by stamp, (N, 4)
        for mav, payloads in self._truths.items():
            for payload in payloads:
                truth = self._decoded(messages.Truth, payload)
                if truth is not None:
                    pose = pose_of(np.concatenate([floats(truth.position), floats(truth.quaternion)]))
                    truths.setdefault(truth.stamp_ns, np.full((self._fleet.mavs, 4), np.nan))[mav - 1] = pose
        mavs = tuple(self._with_status(self._of(mav, truths)) for mav in self._fleet.ids)
        return Progress(max(truths, default=0) / 1e9, self._fleet.duration_s, mavs)

    def _of(self, mav: int, truths: dict[int, Array]) -> MavProgress:
        estimate = self._decoded(messages.Estimate, self._estimates.get(mav))
        if estimate is None or len(estimate.states) != self._fleet.mavs:
            return MavProgress(mav, messages.STATES[SEARCHING], None, "", 0, None)
        least, reason = commits.least_known(estimate.states, mav - 1), ""
        if least.mav is not None:
            registration = self._decoded(messages.Registration, self._registrations.get(mav))
            if registration is not None and len(registration.reasons) == self._fleet.mavs:
                reason = registration.reasons[least.mav]
        localised = [j for j, state in enumerate(estimate.states) if state == LOCALISED and j != mav - 1]
        error_m = None
        if (true := truths.get(estimate.stamp_ns)) is not None:
            believed = floats(estimate.poses).reshape(-1, 4)
            error = relative_pose(believed[mav - 1], believed) - relative_pose(true[mav - 1], true)
            value = metrics.rms(np.linalg.norm(error[localised, :3], axis=-1))
            error_m = value if np.isfinite(value) else None
        number = None if least.mav is None else least.mav + 1
        return MavProgress(mav, messages.STATES[least.state], number, reason, len(localised), error_m)

    def _with_status(self, progress: MavProgress) -> MavProgress:
        status = self._decoded(messages.Status, self._statuses.get(progress.id))
        if status is None:
            return progress
        stale, gone = (
            tuple(index + 1 for index, known in enumerate(status.neighbours) if known == state)
            for state in (messages.STALE, messages.GONE)
        )
        sent = 2 * self._fleet.mavs * (status.seq + 1)  # a tick: odometry and a detection set, of everybody
        return msgspec.structs.replace(
            progress,
            stale=stale,
            gone=gone,
            holding=status.holding,
            lost=max(0.0, 1 - status.received / sent),
            tick_ms=None if status.final else status.tick_us / 1000,
        )

    def _decoded(self, kind: type[messages.M], payload: bytes | None) -> messages.M | None:
        if payload is None:
            return None
        try:
            return messages.decode(kind, payload, self._epoch)
        except messages.Rejected:
            return None
