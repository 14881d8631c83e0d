"""How well could it be done? The agents' own estimator on the same recording, told which detection is whom.

Apart from the composition root the only module of deploy that looks inside an agent.
"""

from typing import Any, NamedTuple

import numpy as np

from agent.config import parse
from agent.estimator.estimator import Estimator
from agent.interface.frames import Array
from deploy.metrics import States
from deploy.recording import UNKNOWN, Recording


class Twin(NamedTuple):
    states: States  # (K, N, N) as in a Recording
    estimates: Array  # (K, N, N, 4) pose of j in i's odometry frame


def replay(recording: Recording, agent: dict[str, Any], told: bool = True) -> Twin:
    """What every agent would have believed; agents that got no survey stay NaN.

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
    K, N = recording.ticks, recording.fleet.mavs
    states = np.full((K, N, N), UNKNOWN, np.uint8)
    estimates = np.full((K, N, N, 4), np.nan)
    for station in recording.fleet.ids:
        survey = recording.surveys.get(station)
        if survey is None:
            continue
        estimator = Estimator(config, recording.fleet, station)
        estimator.start(survey.poses, survey.position_sigma_m, survey.yaw_sigma_rad)
        order = [station, *(mav for mav in recording.fleet.ids if mav != station)]
        for k in range(K):
            readings = recording.odometry[k]
            estimator.predict(
                {mav: readings[mav - 1] for mav in recording.fleet.ids if np.isfinite(readings[mav - 1, 0])}
            )
            for mav in order:
                spherical, labels = recording.detections.get((k, mav)), recording.labels.get((k, mav))
                if spherical is not None and labels is not None and len(labels) == len(spherical):
                    estimator.associate(mav, spherical, labels=labels if told else None)
            beliefs = estimator.finish()
            states[k, station - 1], estimates[k, station - 1] = beliefs.states, beliefs.poses
    return Twin(states, estimates)
