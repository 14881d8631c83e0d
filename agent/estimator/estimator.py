"""Where is everybody? One agent's copy of the coupled filter: predict, associate set by set, finish.

The estimator knows no sockets and no clock. A tick is

    predict(odometry)               every MAV's odometry reading of this tick (those that are there)
    associate(station, detections)  once per detection set, in a fixed order: own first, then by id
    finish()                        what is believed now

Detection sets update the poses (y, Sigma) one after the other, as the paper iterates over its stations; `finish` lifts
the result to the full state.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from agent.config import AgentConfig
from agent.estimator import cpdaf, odometry_model
from agent.estimator.gating import chi_square_quantile
from agent.estimator.joint_update import DetectionSet, joint_update
from agent.estimator.moments import LINEAR_YAW_VARIANCE, DetectionGeometry, PoseMoments, pose_moments
from agent.estimator.prediction import predict
from agent.estimator.state import Poses, State, from_frames
from agent.estimator.station_update import Pairs, station_update
from agent.interface.fleet import Fleet
from agent.interface.frames import Array, wrap
from agent.interface.messages import LOCALISED, SEARCHING

COASTING_SIGMA = (0.5, 0.5)  # m/s per axis and rad/s: how far a MAV may stray from its last velocity while unheard


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
        """For the MAV `station`, 1..N; localises nobody before `start`."""
        self._config, self._fleet, self._station = config, fleet, station
        f = config.filter
        self._sigma_odometry = (f.odometry_sigma_m, f.odometry_sigma_rad)
        self._sigma_drift = (config.odometry.position_sigma_m, config.odometry.yaw_sigma_rad)
        self._rules = cpdaf.Rules(
            chi_square_quantile(f.P_G, 3) if f.gating else np.inf, f.hypothesis_evaluation, f.pruned_mass
        )
        self._gate_95 = chi_square_quantile(0.95, 3)
        self._geometry = [DetectionGeometry(fleet.mavs + 1, s) for s in fleet.ids]
        self._prior: tuple[Array, tuple[float, float]] | None = None
        self._state: State | None = None
        self._readings = np.full((fleet.mavs + 1, 4), np.nan)  # the last tick's odometry; the start's is zero
        self._increments = np.zeros((fleet.mavs + 1, 4))
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
        if self._state is None:
            self._begin(z)
            return
        self._state = self._moved(self._state, z)
        self._take_moments()

    def _begin(self, z: Array) -> None:
        """The first tick for which every reading is there makes the state."""
        if self._prior is not None and np.isfinite(z).all():
            self._readings = z
            frames = np.vstack([self._prior[0], np.zeros(4)])
            self._state = from_frames(frames, z, self._station, self._prior[1], self._sigma_odometry)
            self._take_moments()

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
        state = predict(state, increments, input_sigma, self._sigma_drift)
        return odometry_model.update(state, z, self._sigma_odometry)

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
        if self._state is None or not len(spherical) or self._fleet.mavs == 1:
            return
        density = self._config.detector.clutter_density
        geometry = self._geometry[station - 1]
        self._poses, found = station_update(self._poses, geometry, self._pairs, spherical, density, self._rules, labels)
        self._count(found.distances, found.lost_mass)

    def associate_all(self, sets: list[DetectionSet]) -> None:
        """Updates with all detection sets of the tick: the unambiguous ones at once, the others in the given order."""
        if self._state is None or self._fleet.mavs == 1:
            return
        left = sets
        if self._rules.evaluation and self._poses.Sigma[3::4, 3::4].diagonal().max() <= LINEAR_YAW_VARIANCE:
            density = self._config.detector.clutter_density
            self._poses, left, distances, lost = joint_update(self._poses, self._pairs, sets, density, self._rules)
            self._count(distances, lost)
        for station, spherical, labels in left:
            self.associate(station, spherical, labels)

    def _count(self, distances: Array, lost_mass: float) -> None:
        self._innovations += len(distances)
        self._inside += int((distances <= self._gate_95).sum())
        self._lost_mass = max(self._lost_mass, lost_mass)

    @property
    def poses(self) -> Poses:
        """All poses as they are believed within this tick, in the station's odometry frame; after `predict`."""
        return self._poses

    def finish(self) -> Beliefs:
        """Lifts the tick's pose updates to the state; what is believed now."""
        mavs, own = self._fleet.mavs, self._station - 1
        if self._state is None:
            poses, covariances = np.zeros((mavs, 4)), np.tile(np.eye(4) * 1e6, (mavs, 1, 1))
            states = np.full(mavs, SEARCHING, np.uint8)
            states[own] = LOCALISED
            return Beliefs(states, poses, covariances, np.zeros(4), 0, 0, 0.0)
        if self._poses is not self._before.poses:
            self._state = _lifted(self._state, self._before, self._poses)
        poses = self._poses.by_body.copy()
        poses[:, 3] = wrap(poses[:, 3])
        every = np.arange(mavs)
        covariances = self._poses.Sigma.reshape(mavs + 1, 4, mavs + 1, 4)[every, :, every, :]
        variances = covariances[:, range(4), range(4)]
        known = (variances[:, :3].max(1) < self._config.localised_sigma_m**2) & (
            variances[:, 3] < self._config.localised_sigma_rad**2
        )
        states = np.where(known, LOCALISED, SEARCHING).astype(np.uint8)
        states[own] = LOCALISED
        counts = (self._innovations, self._inside, self._lost_mass)
        return Beliefs(states, poses[:mavs], covariances, poses[mavs], *counts)


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
