"""When did the agents call a MAV localised, and were they right? Pure functions on arrays of a recording.

As in `metrics`, index k is the tick, i the agent, j whom it is about, and what is unknown is NaN and counts nowhere.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array
from agent.interface.messages import LOCALISED, SEARCHING
from deploy.metrics import Errors, States

WRONG_M, WRONG_RAD = 0.5, np.deg2rad(10.0)  # beyond either, calling a MAV localised is a wrong commit
LATER_S = 1.0  # after it was first called localised, an estimate is looked at again


class LeastKnown(NamedTuple):
    """What an agent says of the other MAV that it knows least about."""

    state: int  # index into messages.STATES
    mav: int | None  # its index, the lowest of several; None: everybody is localised, or the agent never spoke


class AtCommit(NamedTuple):
    """How good the estimates are that agents begin with, over all pairs; NaN without any."""

    commit_nees: (
        float  # mean NEES per degree of freedom at the tick at which i first calls j localised: 1 is consistent
    )
    position_1s_m: float  # median relative error, a second after that tick
    yaw_1s_rad: float
    position_1s_p95_m: float  # 95th percentile
    yaw_1s_p95_rad: float


def localised_since(states: States, time_s: Array) -> Array:
    """(N, N) s when agent i first called j localised; NaN: never."""
    called = states == LOCALISED
    if not len(called):
        return np.full(states.shape[1:], np.nan)
    return np.where(called.any(axis=0), time_s[called.argmax(axis=0)], np.nan)


def all_localised_at(states: States, time_s: Array) -> Array:
    """(N,) s when each agent first called all others localised at once; NaN: never."""
    others = states.copy()
    mavs = np.arange(states.shape[1])
    others[:, mavs, mavs] = LOCALISED
    everyone = (others == LOCALISED).all(axis=2)
    if not len(everyone):
        return np.full(len(mavs), np.nan)
    return np.where(everyone.any(axis=0), time_s[everyone.argmax(axis=0)], np.nan)


def wrong_commits(relative_error: Errors, states: States) -> npt.NDArray[np.int64]:
    """(N,) how many MAVs each agent at some time called localised although the relative error was beyond the limits."""
    wrong = (relative_error.position_m > WRONG_M) | (relative_error.yaw_rad > WRONG_RAD)
    return np.asarray(((states == LOCALISED) & wrong).any(axis=0).sum(axis=1), np.int64)


def at_commit(states: States, nees_of_pairs: Array, relative_error: Errors, time_s: Array) -> AtCommit:
    """Of states, NEES and errors (K, N, N) over time (K,); pairs whose run ends within the second have no errors."""
    since_s = localised_since(states, time_s)
    i, j = np.nonzero(np.isfinite(since_s))
    nees = nees_of_pairs[np.searchsorted(time_s, since_s[i, j]), i, j]
    nees = nees[~np.isnan(nees)]
    k = np.searchsorted(time_s, since_s[i, j] + LATER_S - 1e-9)
    i, j, k = i[k < len(time_s)], j[k < len(time_s)], k[k < len(time_s)]
    position_m, yaw_rad = relative_error.position_m[k, i, j], relative_error.yaw_rad[k, i, j]
    return AtCommit(
        float(np.mean(nees) / 4) if nees.size else float("nan"),
        *(_percentile(values, percent) for percent in (50, 95) for values in (position_m, yaw_rad)),
    )


def least_known(states: Iterable[int], agent: int) -> LeastKnown:
    """From the states (N,) of one estimate of this agent (index)."""
    others = [(int(state), mav) for mav, state in enumerate(states) if mav != agent and state != LOCALISED]
    return LeastKnown(*min(others)) if others else LeastKnown(LOCALISED, None)


def least_known_at_last(states: States, agent: int) -> LeastKnown:
    """From the last estimate of this agent (index) among states (K, N, N); searching if it never spoke."""
    spoken = np.flatnonzero(states[:, agent, agent] <= LOCALISED)
    return least_known(states[spoken[-1], agent], agent) if spoken.size else LeastKnown(SEARCHING, None)


def _percentile(values: Array, percent: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percent)) if known.size else float("nan")
