"""Where is everybody? One agent's copy of the coupled filter: predict, associate set by set, finish.

The estimator knows no sockets and no clock. A tick is

    predict(odometry)               every MAV's odometry reading of this tick (those that are there)
    associate(station, detections)  once per detection set, in a fixed order: own first, then by id
    finish()                        what is believed now

Detection sets update the poses (y, Sigma) one after the other, as the paper iterates over its stations; `finish` lifts
the result to the full state.

The filter holds its *members*: the station, and whom it was told of by `start` or `admit`. What is seen of others is
clutter to it.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from agent.config import COASTING_SIGMA, AgentConfig
from agent.estimator import cpdaf, odometry_model
from agent.estimator.gating import chi_square_quantile
from agent.estimator.joint_update import DetectionSet, joint_update
from agent.estimator.membership import conditional, with_newcomers
from agent.estimator.moments import LINEAR_YAW_VARIANCE, DetectionGeometry, PoseMoments, pose_moments
from agent.estimator.prediction import predict
from agent.estimator.state import P_ODOM, PSI, PSI_FRAME, Poses, State, from_frames
from agent.estimator.station_update import Pairs, station_update
from agent.interface.fleet import Fleet
from agent.interface.frames import Array, wrap
from agent.interface.messages import LOCALISED, SEARCHING

BEGUN_ANEW = 1 - 1e-6  # a reading after a silence is further off than this share of them would be


class Beliefs(NamedTuple):
    """What the station believes of every MAV, in the station's odometry frame."""

    states: npt.NDArray[np.uint8]  # (N,) index into messages.STATES
    poses: Array  # (N, 4) x y z m, yaw rad
    covariances: Array  # (N, 4, 4)
    start: Array  # (4,) where the station's odometry began: it has drifted off zero by what the VIO has
    innovations: int  # of detections associated this tick
    innovations_inside: int  # how many lie inside their own 95 % gate
    lost_mass: float  # largest share of hypothesis weight left out in one set


class Estimator:
    def __init__(self, config: AgentConfig, fleet: Fleet, station: int) -> None:
        """For the MAV `station`, 1..N; localises nobody before `start` or `admit`."""
        self._config, self._fleet, self._station = config, fleet, station
        f = config.filter
        self._sigma_odometry = (f.odometry_sigma_m, f.odometry_sigma_rad)
        self._sigma_drift = (config.odometry.position_sigma_m, config.odometry.yaw_sigma_rad)
        self._rules = cpdaf.Rules(
            chi_square_quantile(f.P_G, 3) if f.gating else np.inf, f.hypothesis_evaluation, f.pruned_mass
        )
        self._gate_95 = chi_square_quantile(0.95, 3)
        self._prior: tuple[Array, tuple[float, float]] | None = None
        self._state: State | None = None
        self._readings = np.full((fleet.mavs + 1, 4), np.nan)  # the last tick's odometry; the start's is zero
        self._increments = np.zeros((fleet.mavs + 1, 4))
        self.members: list[int] = []  # MAV numbers, ascending
        self._begin_tick()

    def _begin_tick(self) -> None:
        self._innovations = self._inside = 0
        self._lost_mass = 0.0

    def start(self, frames: Array, position_sigma_m: float, yaw_sigma_rad: float) -> None:
        """Begins from a rough knowledge of all odometry frames (N, 4) in the station's own, at the next `predict`."""
        self._prior = (frames, (position_sigma_m, yaw_sigma_rad))

    def predict(self, odometry: dict[int, Array]) -> None:
        """Moves the belief to this tick: readings (4,) x y z m, yaw rad in each MAV's odometry frame, by MAV."""
        self._begin_tick()
        z = np.full((self._fleet.mavs + 1, 4), np.nan)
        z[-1] = 0.0
        for mav, reading in odometry.items():
            z[mav - 1] = reading
        if self._state is None or (self._prior is not None and np.isfinite(z).all()):
            self._begin(z)
        else:
            self._state = self._moved(self._state, z)
        if self._state is not None:
            self._take_moments()

    def begun_anew(self, odometry: dict[int, Array]) -> list[int]:
        """Members whose reading ends a silence where their odometry cannot have gone meanwhile; before `predict`."""
        if self._state is None:
            return []
        found, state = [], self._state
        blocks = state.P.reshape(state.bodies, 8, state.bodies, 8)
        for k, mav in enumerate(self.members):
            if mav not in odometry or np.isfinite(self._readings[mav - 1, 3]):
                continue
            body, P, reading = state.by_body[k], blocks[k, :, k], odometry[mav]
            moved = reading - self._increments[mav - 1]
            turned = float(wrap(moved[3] - body[PSI] + body[PSI_FRAME]))
            coasting = np.divide(COASTING_SIGMA, self._fleet.rate_hz) ** 2
            variance = P.diagonal()[P_ODOM] + coasting[0]
            yaw_variance = P[PSI, PSI] + P[PSI_FRAME, PSI_FRAME] - 2 * P[PSI, PSI_FRAME] + coasting[1]
            square = float(((moved[:3] - body[P_ODOM]) ** 2 / variance).sum()) + turned**2 / float(yaw_variance)
            if square > chi_square_quantile(BEGUN_ANEW, 4):
                found.append(mav)
        return found

    def _begin(self, z: Array) -> None:
        """Makes the state: of everybody once there is a prior and every reading, before that of the station alone."""
        if self._prior is not None and np.isfinite(z).all():
            self.members = list(self._fleet.ids)
            frames, sigma = np.vstack([self._prior[0], np.zeros(4)]), self._prior[1]
            self._prior = None
        elif np.isfinite(z[self._station - 1]).all():
            self.members = [self._station]
            frames, sigma = np.zeros((2, 4)), (0.0, 0.0)
        else:
            return
        self._readings = z
        self._state = from_frames(frames, z[self._rows], self._row(self._station) + 1, sigma, self._sigma_odometry)

    @property
    def _rows(self) -> list[int]:
        """Where the bodies of the state are in arrays of all MAVs and the start."""
        return [*(mav - 1 for mav in self.members), self._fleet.mavs]

    def _row(self, mav: int) -> int:
        return self.members.index(mav)

    def _moved(self, state: State, z: Array) -> State:
        increments = z - self._readings
        increments[:, 3] = wrap(increments[:, 3])
        input_sigma = np.multiply(np.sqrt(2.0), np.tile(self._sigma_odometry, (len(z), 1)))
        # An increment takes two readings in a row. Without them a MAV goes on as it last did; where that took it is
        # for the reading that ends the silence, and for detections, to say.
        unheard = ~np.isfinite(increments[:, 3])
        if unheard.any():
            increments[unheard] = self._increments[unheard]
            input_sigma[unheard] = np.divide(COASTING_SIGMA, self._fleet.rate_hz)
        self._readings, self._increments = z, increments
        rows = self._rows
        state = predict(state, increments[rows], input_sigma[rows], self._sigma_drift)
        return odometry_model.update(state, z[rows], self._sigma_odometry)

    def _take_moments(self) -> None:
        assert self._state is not None
        self._before: PoseMoments = pose_moments(self._state)
        self._poses: Poses = self._before.poses
        self._pairs = Pairs.at(self._poses, self._config.detector)

    def associate(self, station: int, spherical: Array, labels: npt.NDArray[np.intp] | None = None) -> None:
        """Updates with one detection set.

        Args:
            station: whose set it is, 1..N.
            spherical: (M, 3) range m, azimuth rad, elevation rad in the station's gravity-aligned body frame.
            labels: (M,) for a filter that is told the truth: the MAV that each detection is of, 0 if it is false.
        """
        if self._state is None or not len(spherical) or len(self.members) == 1 or station not in self.members:
            return
        density = self._config.detector.clutter_density
        geometry = _geometry(len(self.members) + 1, self._row(station) + 1)
        if labels is not None:
            labels = self._known(labels)
        self._poses, found = station_update(self._poses, geometry, self._pairs, spherical, density, self._rules, labels)
        self._count(found.distances, found.lost_mass)

    def _known(self, labels: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
        """Labels that count the members only: 1 is the first of them."""
        known = np.zeros(self._fleet.mavs + 1, dtype=np.intp)
        known[self.members] = 1 + np.arange(len(self.members))
        return known[labels]

    def associate_all(self, sets: list[DetectionSet]) -> None:
        """Updates with all detection sets of the tick: the unambiguous ones at once, the others in the given order."""
        if self._state is None or len(self.members) == 1:
            return
        left = [s for s in sets if s.station in self.members]
        if self._rules.evaluation and self._poses.Sigma[3::4, 3::4].diagonal().max() <= LINEAR_YAW_VARIANCE:
            density = self._config.detector.clutter_density
            among = [
                DetectionSet(self._row(s.station) + 1, s.spherical, None if s.labels is None else self._known(s.labels))
                for s in left
            ]
            self._poses, undone, distances, lost = joint_update(self._poses, self._pairs, among, density, self._rules)
            self._count(distances, lost)
            again = {s.station for s in undone}
            left = [s for s in left if self._row(s.station) + 1 in again]
        for station, spherical, labels in left:
            self.associate(station, spherical, labels)

    def _count(self, distances: Array, lost_mass: float) -> None:
        self._innovations += len(distances)
        self._inside += int((distances <= self._gate_95).sum())
        self._lost_mass = max(self._lost_mass, lost_mass)

    @property
    def poses(self) -> Poses:
        """Poses of the members, then of the start, as they are believed within this tick, in the station's odometry
        frame; after `predict`."""
        return self._poses

    def finish(self) -> Beliefs:
        """Lifts the tick's pose updates to the state; what is believed now."""
        if self._state is not None and self._poses is not self._before.poses:
            self._state = _lifted(self._state, self._before, self._poses)
            self._before = self._before._replace(poses=self._poses)
        return self.beliefs()

    def beliefs(self) -> Beliefs:
        """What is believed after `finish`, `admit` and `dismiss`."""
        mavs, own, counts = self._fleet.mavs, self._station - 1, (self._innovations, self._inside, self._lost_mass)
        poses, covariances = np.zeros((mavs, 4)), np.tile(np.eye(4) * 1e6, (mavs, 1, 1))
        states, start = np.full(mavs, SEARCHING, np.uint8), np.zeros(4)
        if self._state is not None:
            rows, every = self._rows[:-1], np.arange(len(self.members))
            bodies = len(every) + 1
            by_body = self._poses.by_body.copy()
            by_body[:, 3] = wrap(by_body[:, 3])
            poses[rows], start = by_body[:-1], by_body[-1]
            covariances[rows] = self._poses.Sigma.reshape(bodies, 4, bodies, 4)[every, :, every, :]
            variances = covariances[:, range(4), range(4)]
            known = (variances[:, :3].max(1) < self._config.localised_sigma_m**2) & (
                variances[:, 3] < self._config.localised_sigma_rad**2
            )
            states[known] = LOCALISED
        states[own] = LOCALISED
        return Beliefs(states, poses, covariances, start, *counts)

    def admit(self, newcomers: list[int], y: Array, Sigma: Array) -> None:
        """Takes in MAVs that were not members, after `finish`; each must have been heard in this tick.

        What is handed over is the distribution of the newcomers *given* the members and the start: so what is known of
        these already is not counted twice, and a team that flies on is not disturbed.

        Args:
            newcomers: MAV numbers.
            y: (N + 1, 4) mean poses of all MAVs and the start in the station's odometry frame.
            Sigma: (4 (N + 1), 4 (N + 1)) their joint covariance; only rows of newcomers and members are looked at.
        """
        assert self._state is not None
        readings = self._readings[[mav - 1 for mav in newcomers]]
        assert np.isfinite(readings).all(), "a newcomer was not heard"
        old = [row for row in self._rows if row != self._station - 1]
        new = [mav - 1 for mav in newcomers]
        known = [k for k, row in enumerate(self._rows) if row != self._station - 1]
        joint = conditional(y, Sigma, new, old)
        state = with_newcomers(self._state, self._poses, known, joint, readings, self._sigma_odometry)
        order = np.argsort([*self._rows[:-1], *new], kind="stable")
        bodies = len(self._rows)
        at = [*range(bodies - 1), *range(bodies, bodies + len(new))]
        self.members = sorted([*self.members, *newcomers])
        self._rebuild(state, [*(at[k] for k in order), bodies - 1])

    def dismiss(self, mavs: list[int]) -> None:
        """Forgets members (not the station), after `finish`."""
        assert self._state is not None
        assert self._station not in mavs, "a station cannot forget itself"
        kept = [k for k, mav in enumerate(self.members) if mav not in mavs]
        last = len(self.members)
        self.members = [self.members[k] for k in kept]
        self._rebuild(self._state, [*kept, last])

    def _rebuild(self, state: State, bodies: list[int]) -> None:
        """Keeps these bodies of the state, in this order."""
        entries = (8 * np.array(bodies)[:, None] + np.arange(8)).ravel()
        self._state = State(state.x[entries], state.P[np.ix_(entries, entries)], self._row(self._station) + 1)
        self._take_moments()


@lru_cache(maxsize=256)
def _geometry(bodies: int, station: int) -> DetectionGeometry:
    return DetectionGeometry(bodies, station)


def _lifted(state: State, before: PoseMoments, after: Poses) -> State:
    """The state given what the tick's detections changed in the poses: exact for jointly Gaussian (x, y)."""
    Sigma = before.poses.Sigma
    factor, info = lapack.dpotrf(Sigma, lower=1, clean=1)
    assert info == 0, "the covariance of the poses is not positive definite"
    Gt, _ = lapack.dpotrs(factor, before.P_xy.T, lower=1)
    x = state.x + (after.y - before.poses.y) @ Gt
    P = state.P - Gt.T @ (Sigma - after.Sigma) @ Gt
    P += P.T
    P *= 0.5
    return State(x, P, state.station)
