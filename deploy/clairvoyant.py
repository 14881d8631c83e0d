"""How well could it be done? The agents' own estimator on the same recording, told which detection is whom.

Apart from the composition root the only module of deploy that looks inside an agent.
"""

from typing import Any

import numpy as np

from agent.config import parse
from agent.estimator.estimator import Estimator
from agent.estimator.joint_update import DetectionSet
from agent.interface.frames import relative_pose
from deploy.metrics import odometry_origins
from deploy.recording import Beliefs, Recording, Survey

TRUE_START_SIGMA = (0.2, 0.1)  # m per axis, rad


def replay(recording: Recording, agent: dict[str, Any], told: bool = True) -> Beliefs:
    """What every agent would have believed. Without a survey it begins from the truth, as roughly as a survey would be:
    who is told which detection is whom need not find out who is where.

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
    twin = Beliefs.none(recording.ticks, recording.fleet.mavs)
    for station in recording.fleet.ids:
        survey = recording.surveys.get(station) or _true_start(recording, station)
        if survey is None:
            continue
        estimator = Estimator(config, recording.fleet, station)
        estimator.start(survey.poses, survey.position_sigma_m, survey.yaw_sigma_rad)
        order = [station, *(mav for mav in recording.fleet.ids if mav != station)]
        for k in range(recording.ticks):
            heard = {
                mav: recording.odometry[k, mav - 1] for mav in order if np.isfinite(recording.odometry[k, mav - 1, 0])
            }
            estimator.predict(heard)
            estimator.associate_all(
                [
                    DetectionSet(mav, recording.detections[k, mav], recording.labels[k, mav] if told else None)
                    for mav in heard
                    if _labelled(recording, k, mav)
                ]
            )
            believed = estimator.finish()
            twin.states[k, station - 1], twin.estimates[k, station - 1] = believed.states, believed.poses
            twin.starts[k, station - 1] = believed.start
    return twin


def _true_start(recording: Recording, station: int) -> Survey | None:
    """Where all odometry frames began, in the station's; None if the truth of some MAV was not recorded."""
    origins = odometry_origins(recording.true_poses, recording.odometry)
    frames = relative_pose(np.repeat(origins[station - 1 : station], len(origins), axis=0), origins)
    return Survey(frames, *TRUE_START_SIGMA) if np.isfinite(frames).all() else None


def _labelled(recording: Recording, k: int, mav: int) -> bool:
    detections, labels = recording.detections.get((k, mav)), recording.labels.get((k, mav))
    return detections is not None and labels is not None and len(detections) == len(labels)
