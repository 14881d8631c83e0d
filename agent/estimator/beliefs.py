"""What does a station say that it believes, and of whom does it say that he is localised?"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.estimator.state import Poses
from agent.interface.frames import Array, wrap
from agent.interface.messages import LOCALISED, SEARCHING


class Beliefs(NamedTuple):
    """What the station believes of every MAV, in the station's odometry frame."""

    states: npt.NDArray[np.uint8]  # (N,) index into messages.STATES
    poses: Array  # (N, 4) x y z m, yaw rad
    covariances: Array  # (N, 4, 4)
    start: Array  # (4,) where the station's odometry began: it has drifted off zero by what the VIO has
    innovations: int  # of detections associated this tick
    innovations_inside: int  # how many lie inside their own 95 % gate
    lost_mass: float  # largest share of hypothesis weight left out in one set


class Counts(NamedTuple):
    """Of one tick."""

    innovations: int
    inside: int  # their own 95 % gate
    lost_mass: float


NOTHING = Counts(0, 0, 0.0)


def beliefs_of(
    poses: Poses | None, rows: list[int], own: int, mavs: int, config: AgentConfig, counts: Counts
) -> Beliefs:
    """From the poses of the members and the start; None before there are any.

    Args:
        poses: of the members and of the start.
        rows: of the members, in this order: their numbers less one.
        own: the station's row.
        mavs: how many there are.
        config: which uncertainty is small enough to be called localised.
        counts: of this tick.
    """
    found, covariances = np.zeros((mavs, 4)), np.tile(np.eye(4) * 1e6, (mavs, 1, 1))
    states, start = np.full(mavs, SEARCHING, np.uint8), np.zeros(4)
    if poses is not None:
        every, bodies = np.arange(len(rows)), len(rows) + 1
        by_body = poses.by_body.copy()
        by_body[:, 3] = wrap(by_body[:, 3])
        found[rows], start = by_body[:-1], by_body[-1]
        covariances[rows] = poses.Sigma.reshape(bodies, 4, bodies, 4)[every, :, every, :]
        variances = covariances[:, range(4), range(4)]
        known = (variances[:, :3].max(1) < config.localised_sigma_m**2) & (
            variances[:, 3] < config.localised_sigma_rad**2
        )
        states[known] = LOCALISED
    states[own] = LOCALISED
    return Beliefs(states, found, covariances, start, *counts)
