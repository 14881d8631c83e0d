"""How well could it be done? The agents' own estimator on the same recording, told which detection is whom.

It is given what each agent was given: of a run with faults, what arrived, when it arrived. Apart from the composition
root the only module of deploy that looks inside an agent.
"""

from typing import Any, NamedTuple

import numpy as np

from agent.config import AgentConfig, parse
from agent.estimator.estimator import Estimator
from agent.estimator.joint_update import DetectionSet
from agent.interface.frames import Array, compose, relative_pose
from deploy.metrics import odometry_origins
from deploy.recording import GONE, Beliefs, Recording, Survey

TRUE_START_SIGMA = (0.2, 0.1)  # m per axis, rad


def replay(recording: Recording, agent: dict[str, Any], told: bool = True) -> Beliefs:
    """What every agent would have believed. Without a survey it begins from the truth, as roughly as a survey would be:
    who is told which detection is whom need not find out who is where. One that starts anew, or late, begins so too.

    Detection sets are taken in the agents' order: each tick the own one first, then by MAV number. A set whose labels
    were not recorded is left out.

    Args:
        recording: what happened.
        agent: the experiment's [agent] table.
        told: which detection is whom; untold, the twin believes what the agents did, to the last bit.

    Raises:
        BadExperiment: the table is wrong.
    """
    config = parse(agent)
    beliefs = Beliefs.none(recording.ticks, recording.fleet.mavs)
    for station in recording.fleet.ids:
        twin: _Twin | None = None
        for k, incarnation in enumerate(recording.incarnations[:, station - 1]):
            if incarnation == GONE:
                continue
            if twin is None or twin.incarnation != incarnation:
                twin = _Twin(config, recording, station, k, told)
            if not twin.lost:
                twin.estimate(k, beliefs)
    return beliefs


class _Heard(NamedTuple):
    odometry: dict[int, Array]  # by MAV
    sets: list[int]  # whose detection sets, in the order in which they are taken


def _heard(recording: Recording, k: int, station: int) -> _Heard:
    """What this agent was given for this tick: its own, and what arrived in time. What arrives later is not used."""
    order = [station, *(mav for mav in recording.fleet.ids if mav != station)]
    here = [mav for mav in order if np.isfinite(recording.odometry[k, mav - 1, 0])]
    with_sets = here
    if recording.arrivals:
        punctual = {(each.sender, each.topic) for each in recording.arrivals.get((k, station), []) if each.tick == k}
        here = [mav for mav in here if mav == station or (mav, "odometry") in punctual]
        with_sets = [mav for mav in here if mav == station or (mav, "detections") in punctual]
    odometry = {mav: recording.odometry[k, mav - 1] for mav in here}
    return _Heard(odometry, [mav for mav in with_sets if _labelled(recording, k, mav)])


class _Twin:
    """Of one agent, in one life of its process."""

    def __init__(self, config: AgentConfig, recording: Recording, station: int, k: int, told: bool) -> None:
        """Begins at tick k."""
        self._recording, self._station, self._began, self._told = recording, station, k, told
        self._estimator = Estimator(config, recording.fleet, station)
        self._lives = recording.incarnations[k].copy()  # as the filter knows the MAVs
        self.incarnation = recording.incarnations[k, station - 1]
        everybody = bool((self._lives != GONE).all())
        survey = recording.surveys.get(station) if k == 0 else None
        self._surveyed = survey is not None
        if survey is None and everybody:
            survey = _true_start(recording, station, k)
        self.lost = survey is None and everybody  # the truth is not known
        if survey is not None:
            self._estimator.start(survey.poses, survey.position_sigma_m, survey.yaw_sigma_rad)

    def estimate(self, k: int, beliefs: Beliefs) -> None:
        """One tick; what is believed then is entered."""
        recording, estimator = self._recording, self._estimator
        heard = _heard(recording, k, self._station)
        odometry = heard.odometry
        if k == self._began and not self._surveyed:  # it is told where they all are, so it has heard them all
            odometry = {mav: z for mav, z in enumerate(recording.odometry[k], 1) if np.isfinite(z).all()}
        self._forget_lives(k)
        estimator.predict(odometry)
        estimator.associate_all(
            [
                DetectionSet(mav, recording.detections[k, mav], recording.labels[k, mav] if self._told else None)
                for mav in heard.sets
            ]
        )
        estimator.finish()
        if not self._surveyed:
            self._admit(k, [mav for mav in odometry if mav not in estimator.members])
        believed, i = estimator.beliefs(), self._station - 1
        beliefs.states[k, i], beliefs.estimates[k, i] = believed.states, believed.poses
        beliefs.starts[k, i] = believed.start

    def _forget_lives(self, k: int) -> None:
        """Those that have been started anew have another odometry frame."""
        now = self._recording.incarnations[k]
        anew = [mav for mav in self._estimator.members if now[mav - 1] not in (GONE, self._lives[mav - 1])]
        if anew:
            self._estimator.dismiss(anew)
        self._lives = np.where(now == GONE, self._lives, now)

    def _admit(self, k: int, newcomers: list[int]) -> None:
        """Those whom it hears for the first time, or again, are where they are in truth."""
        true, estimator, i = self._recording.true_poses[k], self._estimator, self._station - 1
        newcomers = [mav for mav in newcomers if np.isfinite(true[[i, mav - 1]]).all()]
        if not newcomers or not estimator.members:
            return
        own = estimator.poses.by_body[estimator.members.index(self._station)]
        y = np.zeros((len(true) + 1, 4))
        y[:-1] = compose(own, relative_pose(true[i], true))
        sigmas = np.tile([TRUE_START_SIGMA[0]] * 3 + [TRUE_START_SIGMA[1]], len(y))
        estimator.admit(sorted(newcomers), np.nan_to_num(y), np.diag(sigmas**2))


def _true_start(recording: Recording, station: int, k: int) -> Survey | None:
    """Where all odometry frames are at tick k, in the station's; None if the truth of some MAV was not recorded."""
    origins = odometry_origins(recording.true_poses[k:], recording.odometry[k:])
    frames = relative_pose(np.repeat(origins[station - 1 : station], len(origins), axis=0), origins)
    return Survey(frames, *TRUE_START_SIGMA) if np.isfinite(frames).all() else None


def _labelled(recording: Recording, k: int, mav: int) -> bool:
    detections, labels = recording.detections.get((k, mav)), recording.labels.get((k, mav))
    return detections is not None and labels is not None and len(detections) == len(labels)
