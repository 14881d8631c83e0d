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

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.estimator import cpdaf, odometry_model, visibility
from agent.estimator.beliefs import NOTHING, Beliefs, Counts, beliefs_of
from agent.estimator.gating import chi_square_quantile
from agent.estimator.innovations import Innovations
from agent.estimator.joint_update import DetectionSet, joint_update
from agent.estimator.membership import conditional, with_newcomers
from agent.estimator.moments import LINEAR_YAW_VARIANCE, PoseMoments, detection_geometry, lifted, pose_moments
from agent.estimator.motion import Model, Motion, Step
from agent.estimator.prediction import predict
from agent.estimator.prior import Prior
from agent.estimator.state import Poses, State, from_frames
from agent.estimator.station_update import Pairs, station_update
from agent.interface.fleet import Fleet
from agent.interface.frames import Array


class Snapshot(NamedTuple):
    """What the estimator knows after a tick."""

    state: State | None
    motion: Motion
    members: list[int]
    prior: Prior | None
    moments: PoseMoments | None  # of the state
    in_view: Array  # (N,) see `visibility`


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
        self._prior: Prior | None = None
        self._state: State | None = None
        self._before: PoseMoments | None = None  # of the state
        self._motion = Motion.begin(Model.of(config, fleet), fleet.mavs)
        self._in_view = np.ones(fleet.mavs)  # probabilities, see `visibility`
        self.members: list[int] = []  # MAV numbers, ascending
        self.counts = NOTHING

    def start(self, frames: Array, position_sigma_m: float, yaw_sigma_rad: float) -> None:
        """Takes in everybody who is read, from a rough knowledge of all odometry frames (N, 4) in the station's own."""
        self._prior = Prior(frames, position_sigma_m, yaw_sigma_rad)

    def predict(self, odometry: dict[int, Array]) -> None:
        """Moves the belief to this tick: readings (4,) x y z m, yaw rad in each MAV's odometry frame, by MAV."""
        z = np.full((self._fleet.mavs, 4), np.nan)
        for mav, reading in odometry.items():
            z[mav - 1] = reading
        self.predict_from(z, np.zeros(self._fleet.mavs, np.intp))

    def predict_from(self, readings: Array, between: npt.NDArray[np.intp]) -> None:
        """Moves the belief to this tick.

        Args:
            readings: (N, 4) x y z m, yaw rad in each MAV's odometry frame; NaN where there is none.
            between: (N,) 0, or where it is interpolated: ticks between the two readings it lies between.
        """
        self.counts = NOTHING
        z = np.concatenate([readings, np.zeros((1, 4))])  # the start has not moved
        step = self._motion.step(z, np.append(between, 0))
        self._motion = step.motion
        self._in_view = visibility.later(self._in_view, step.motion.silent[:-1], 1 / self._fleet.rate_hz)
        if self._state is None:
            self._begin(z)
        else:
            self._state = self._moved(self._state, z, step)
        if self._state is not None:
            self._take_moments()
            if self._prior is not None:
                self._join(self._prior, z)

    def _begin(self, z: Array) -> None:
        """Makes the state once the station's odometry is there: of all who are read, if there is a prior on them."""
        if np.isnan(z[self._station - 1, 3]):
            return
        self.members, frames, sigma = [self._station], np.zeros((2, 4)), (0.0, 0.0)
        if self._prior is not None:
            rows, prior = self._prior.of(z[:-1]), self._prior
            self.members, self._prior = [row + 1 for row in rows], prior.without(rows)
            frames, sigma = np.vstack([prior.frames[rows], np.zeros(4)]), (prior.position_sigma_m, prior.yaw_sigma_rad)
        self._state = from_frames(frames, z[self._rows], self._row(self._station) + 1, sigma, self._sigma_odometry)

    def _join(self, prior: Prior, z: Array) -> None:
        """Takes in those of the prior who are read for the first time."""
        rows = prior.of(z[:-1])
        newcomers = [row + 1 for row in rows if row + 1 not in self.members]
        if newcomers:
            self.admit(newcomers, *prior.poses(z[:-1]))
        self._prior = prior.without(rows)

    @property
    def _rows(self) -> list[int]:
        """Where the bodies of the state are in arrays of all MAVs and the start."""
        return [*(mav - 1 for mav in self.members), self._fleet.mavs]

    def _row(self, mav: int) -> int:
        return self.members.index(mav)

    def _moved(self, state: State, z: Array, step: Step) -> State:
        rows = self._rows
        state = predict(state, step.increments[rows], step.sigma[rows], self._sigma_drift, step.coasting[rows])
        between = step.motion.between[rows, None] > 0  # no reading, whatever it may be close to
        return odometry_model.update(state, np.where(between, np.nan, z[rows]), self._sigma_odometry)

    def _take_moments(self) -> None:
        assert self._state is not None
        self._before = pose_moments(self._state)
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
        geometry = detection_geometry(len(self.members) + 1, self._row(station) + 1)
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
        among = [
            DetectionSet(self._row(s.station) + 1, s.spherical, None if s.labels is None else self._known(s.labels))
            for s in left
        ]
        stations, density = [s.station - 1 for s in among], self._config.detector.clutter_density
        found = Innovations.of(self._poses, self._pairs, stations, [s.spherical for s in among])
        if self._in_view.min() < 1 and all(s.labels is None for s in left):
            self._look_for_silent(stations, found, density)
        if self._rules.evaluation and self._poses.Sigma[3::4, 3::4].diagonal().max() <= LINEAR_YAW_VARIANCE:
            self._poses, undone, distances, lost = joint_update(
                self._poses, self._pairs, among, found, density, self._rules
            )
            self._count(distances, lost)
            again = {s.station for s in undone}
            left = [s for s, own in zip(left, among, strict=True) if own.station in again]
        for station, spherical, labels in left:
            self.associate(station, spherical, labels)

    def _look_for_silent(self, stations: list[int], found: Innovations | None, density: float) -> None:
        """From here on in this tick, their P_D is multiplied by the probability that they are in view, before it."""
        rows = self._rows[:-1]
        in_view = np.append(self._in_view[rows], 1.0)
        after = visibility.looked_for(in_view, self._pairs, stations, found, density)
        self._pairs = self._pairs._replace(P_D=self._pairs.P_D * in_view)
        self._in_view = self._in_view.copy()
        self._in_view[rows] = after[:-1]

    def _count(self, distances: Array, lost_mass: float) -> None:
        before, inside = self.counts, int((distances <= self._gate_95).sum())
        self.counts = Counts(
            before.innovations + len(distances), before.inside + inside, max(before.lost_mass, lost_mass)
        )

    @property
    def poses(self) -> Poses:
        """Poses of the members, then of the start, as they are believed within this tick, in the station's odometry
        frame; after `predict`."""
        return self._poses

    def frames(self) -> Array:
        """(N, 4) x y z m, yaw rad of every odometry frame, in the station's; NaN where not known. After `finish`."""
        found = np.full((self._fleet.mavs, 4), np.nan)
        if self._state is not None:
            found[self._rows[:-1]] = self._state.by_body[:-1, 4:]
        return found

    def finish(self) -> Beliefs:
        """Lifts the tick's pose updates to the state; what is believed now."""
        self.lift()
        return self.beliefs()

    def lift(self) -> None:
        """`finish`, for who does not ask what is believed."""
        if self._state is not None and self._before is not None and self._poses is not self._before.poses:
            self._state = lifted(self._state, self._before, self._poses)
            self._before = self._before._replace(poses=self._poses)

    def beliefs(self) -> Beliefs:
        """What is believed after `finish`, `admit` and `dismiss`."""
        poses = None if self._state is None else self._poses
        return beliefs_of(poses, self._rows[:-1], self._station - 1, self._fleet.mavs, self._config, self.counts)

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
        readings = self._motion.past[-1, [mav - 1 for mav in newcomers]]
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
        self._prior = self._prior and self._prior.without([mav - 1 for mav in mavs])

    def lose_track(self, mavs: list[int]) -> None:
        """Forgets where the odometry of these MAVs was, after it began anew."""
        self._motion = self._motion.without([mav - 1 for mav in mavs])

    @property
    def motion(self) -> Motion:
        """Of all MAVs, members or not, up to this tick."""
        return self._motion

    def snapshot(self) -> Snapshot:
        """All that is known between two ticks. It costs nothing: arrays are replaced, never changed."""
        return Snapshot(self._state, self._motion, self.members, self._prior, self._before, self._in_view)

    def restore(self, then: Snapshot) -> None:
        """Goes back to where it was."""
        self._state, self._motion, self.members, self._prior, self._before, self._in_view = then
        if then.moments is not None:
            self._poses = then.moments.poses

    def _rebuild(self, state: State, bodies: list[int]) -> None:
        """Keeps these bodies of the state, in this order."""
        entries = (8 * np.array(bodies)[:, None] + np.arange(8)).ravel()
        self._state = State(state.x[entries], state.P[np.ix_(entries, entries)], self._row(self._station) + 1)
        self._take_moments()
