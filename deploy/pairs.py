"""Which pairs of MAVs are scored when there are faults? Those that are alive and connected, once they have settled.

As in `metrics`, index k is the tick, i the agent, j whom it is about.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array
from agent.interface.messages import LOCALISED
from deploy.faults import Faults
from deploy.link_model import is_cut
from deploy.metrics import SETTLING_S, Mask, States
from deploy.recording import GONE, Recording

Incarnations = npt.NDArray[np.int64]


class Pairs(NamedTuple):
    """(K, N, N) each."""

    alive: Mask  # both take part
    connected: Mask  # nothing cuts one off from the other, either way
    again: Mask  # alive and connected, and if once they were not, they have had the time to settle since
    cut_off: Mask  # both take part, but they are not connected


def pairs_of(incarnations: Incarnations, faults: Faults, time_s: Array) -> Pairs:
    """From who took part (K, N), and the schedule of the faults."""
    here = incarnations != GONE
    alive = here[:, :, None] & here[:, None, :]
    connected = _connected(faults, incarnations.shape[1], time_s)
    apart = ~(alive & connected)
    # A pair is together again from its first tick on after the last at which it was apart, or somebody began anew.
    apart[1:] |= (incarnations[1:] != incarnations[:-1])[:, :, None] | (incarnations[1:] != incarnations[:-1])[:, None]
    return Pairs(alive, connected, alive & connected & ~_within(apart, time_s, SETTLING_S), alive & ~connected)


def localised_since(states: States, incarnations: Incarnations, time_s: Array) -> Array:
    """(K, N, N) s when agent i first called j localised in the present lives of both; NaN: not by then.

    Who knew a MAV before it began anew may call it localised for a moment longer: in a later life, that counts only if
    it lasts until the estimate is scored.
    """
    since = np.full(states.shape, np.nan)
    first_life = np.ones(states.shape[1:], bool)
    for k in range(len(states)):
        called = states[k] == LOCALISED
        if k:
            same = incarnations[k] == incarnations[k - 1]
            both = same[:, None] & same[None, :]
            first_life &= both
            in_vain = ~first_life & ~called & (time_s[k] - since[k - 1] < SETTLING_S - 1e-9)
            since[k] = np.where(both & ~in_vain, since[k - 1], np.nan)
        since[k] = np.where(np.isnan(since[k]) & called, time_s[k], since[k])
    return since


def _connected(faults: Faults, mavs: int, time_s: Array) -> Mask:
    connected = np.ones((len(time_s), mavs, mavs), bool)
    if not faults.on_links:
        return connected
    changes = {0.0}
    changes |= {change for rule in faults.rules() for change in (rule.from_s, rule.until_s)}
    changes |= {change for partition in faults.partitions for change in (partition.from_s, partition.until_s)}
    for begin, end in zip(sorted(changes), [*sorted(changes)[1:], np.inf], strict=True):
        during = (time_s >= begin - 1e-9) & (time_s < end - 1e-9)
        if during.any():
            cut = np.array(
                [[i != j and is_cut(faults, i, j, begin) for i in range(1, mavs + 1)] for j in range(1, mavs + 1)]
            )
            connected[during] = ~(cut | cut.T)
    return connected


def _within(events: Mask, time_s: Array, duration_s: float) -> Mask:
    """Where an event of (K, ...) was at this time or less than so long before."""
    last_s = np.where(events, time_s.reshape(-1, *[1] * (events.ndim - 1)), -np.inf)
    last_s = np.maximum.accumulate(last_s, axis=0)
    return np.asarray(time_s.reshape(-1, *[1] * (events.ndim - 1)) - last_s < duration_s - 1e-9)


def first_of_spell(holds: Mask) -> npt.NDArray[np.int64]:
    """(K, N, N) the tick at which what holds now began to; where it does not hold, the present tick."""
    ticks = np.arange(len(holds))[:, None, None]
    return np.minimum(np.maximum.accumulate(np.where(holds, 0, ticks + 1), axis=0), ticks)


class LateStart(NamedTuple):
    """How one that was started anew, or joined late, found into the team; NaN: not by the end, or its next fault."""

    mav: int
    do: str  # restart | join
    at_s: float
    localised_others_after_s: float
    localised_by_others_after_s: float


def late_starts(recording: Recording, since_s: Array) -> list[LateStart]:
    """Of every restart and late join, from `localised_since` of the agents' beliefs."""
    found = []
    for fault in recording.process_faults:
        if fault.do not in ("restart", "join") or fault.tick >= recording.ticks:
            continue
        ends = [each.tick for each in recording.process_faults if each.mav == fault.mav and each.tick > fault.tick]
        last, i = min([*ends, recording.ticks]) - 1, fault.mav - 1
        others = (recording.incarnations[last] != GONE) & (np.arange(recording.fleet.mavs) != i)
        at_s = recording.time_s[fault.tick]
        found.append(
            LateStart(
                fault.mav,
                fault.do,
                float(at_s),
                float(since_s[last, i, others].max(initial=at_s) - at_s),
                float(since_s[last, others, i].max(initial=at_s) - at_s),
            )
        )
    return found
