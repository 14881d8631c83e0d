"""How well could it be done? The agents' own estimator on the same recording, told which detection is whom.

It is given what each agent was given: of a run with faults, what arrived, when it arrived. Apart from the composition
root the only module of deploy that looks inside an agent.
"""

from typing import Any, NamedTuple

import numpy as np

from agent.config import AgentConfig, parse
from agent.estimator.history import History
from agent.estimator.joint_update import DetectionSet
from agent.interface.frames import compose, relative_pose
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
    config = parse(agent, recording.fleet)
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
    """What an agent was given in one tick: of which tick and MAV."""

    odometry: list[tuple[int, int]]
    sets: list[tuple[int, int]]


def _heard(recording: Recording, k: int, station: int) -> _Heard:
    """Its own, and what arrived; in the order in which sets are taken."""
    order = [station, *(mav for mav in recording.fleet.ids if mav != station)]
    if recording.arrivals:
        arrived = recording.arrivals.get((k, station), [])
        odometry = [(each.tick, each.sender) for each in arrived if each.topic == "odometry"]
        sets = [(each.tick, each.sender) for each in arrived if each.topic == "detections"]
        heard = _Heard([(k, station), *odometry], [(k, station), *sets])
    else:
        heard = _Heard([(k, mav) for mav in order], [(k, mav) for mav in order])
    return _Heard(
        [(tick, mav) for tick, mav in heard.odometry if np.isfinite(recording.odometry[tick, mav - 1, 0])],
        sorted((each for each in heard.sets if _labelled(recording, *each)), key=lambda each: order.index(each[1])),
    )


class _Twin:
    """Of one agent, in one life of its process."""

    def __init__(self, config: AgentConfig, recording: Recording, station: int, k: int, told: bool) -> None:
        """Begins at tick k."""
        self._recording, self._station, self._began, self._told = recording, station, k, told
        self._history = History(config, recording.fleet, station)
        self._lives = recording.incarnations[k].copy()  # as the filter knows the MAVs
        self.incarnation = recording.incarnations[k, station - 1]
        everybody = bool((self._lives != GONE).all())
        survey = recording.surveys.get(station) if k == 0 else None
        self._surveyed = survey is not None
        if survey is None and everybody:
            survey = _true_start(recording, station, k)
        self.lost = survey is None and everybody  # the truth is not known
        if survey is not None:
            self._history.start(survey.poses, survey.position_sigma_m, survey.yaw_sigma_rad)

    def estimate(self, k: int, beliefs: Beliefs) -> None:
        """One tick; what is believed then is entered."""
        recording, history, i = self._recording, self._history, self._station - 1
        heard = _heard(recording, k, self._station)
        readings = heard.odometry
        if k == self._began and not self._surveyed:  # it is told where they all are, so it has heard them all
            everybody = [(k, mav) for mav, z in enumerate(recording.odometry[k], 1) if np.isfinite(z).all()]
            readings = [*everybody, *(each for each in readings if each[0] != k)]
        for tick, mav in readings:
            if tick < k:
                history.late(tick, mav, odometry=recording.odometry[tick, mav - 1])
        for tick, mav in heard.sets:
            if tick < k:
                history.late(tick, mav, seen=self._set(tick, mav))
        history.hear(
            k,
            {mav: recording.odometry[k, mav - 1] for tick, mav in readings if tick == k},
            [self._set(k, mav) for tick, mav in heard.sets if tick == k],
        )
        self._forget_lives(k)
        history.estimate()
        if not self._surveyed:
            self._admit(readings)
        believed = history.beliefs()
        beliefs.states[k, i], beliefs.estimates[k, i] = believed.states, believed.poses
        beliefs.starts[k, i] = believed.start

    def _set(self, tick: int, mav: int) -> DetectionSet:
        labels = self._recording.labels[tick, mav] if self._told else None
        return DetectionSet(mav, self._recording.detections[tick, mav], labels)

    def _forget_lives(self, k: int) -> None:
        """Those that have been started anew have another odometry frame."""
        now, history = self._recording.incarnations[k], self._history
        anew = [mav for mav in self._recording.fleet.ids if now[mav - 1] not in (GONE, self._lives[mav - 1])]
        for mav in anew:
            history.forget_odometry(mav, k)
        anew = sorted({*anew, *history.begun_anew()})
        if self._station in anew:
            history.begin_anew()
        elif anew:
            history.dismiss(anew, anew)
        self._lives = np.where(now == GONE, self._lives, now)

    def _admit(self, readings: list[tuple[int, int]]) -> None:
        """Those whom it hears for the first time, or again, are where they are in truth."""
        i = self._station - 1
        for tick, mav in sorted(readings):
            true, team = self._recording.true_poses[tick], self._history.team(tick)
            if team is None or mav in self._history.members or not np.isfinite(true[[i, mav - 1]]).all():
                continue
            own = team.poses.by_body[team.members.index(self._station)]
            y = np.zeros((len(true) + 1, 4))
            y[:-1] = compose(own, relative_pose(true[i], true))
            sigmas = np.tile([TRUE_START_SIGMA[0]] * 3 + [TRUE_START_SIGMA[1]], len(y))
            self._history.admit(tick, [mav], np.nan_to_num(y), np.diag(sigmas**2))


def _true_start(recording: Recording, station: int, k: int) -> Survey | None:
    """Where all odometry frames are at tick k, in the station's; None if the truth of some MAV was not recorded."""
    origins = odometry_origins(recording.true_poses[k:], recording.odometry[k:])
    frames = relative_pose(np.repeat(origins[station - 1 : station], len(origins), axis=0), origins)
    return Survey(frames, *TRUE_START_SIGMA) if np.isfinite(frames).all() else None


def _labelled(recording: Recording, k: int, mav: int) -> bool:
    detections, labels = recording.detections.get((k, mav)), recording.labels.get((k, mav))
    return detections is not None and labels is not None and len(detections) == len(labels)
