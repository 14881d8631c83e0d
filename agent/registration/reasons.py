"""Why is a MAV not localised? The state of each, in one of three words and in a sentence."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array
from agent.interface.messages import AMBIGUOUS, LOCALISED, MAX_HYPOTHESES, SEARCHING
from agent.registration.hypotheses import LEAST_SIGMA, SAME_M, Hypotheses
from agent.registration.verdict import LEAST_TICKS, Verdict

Mask = npt.NDArray[np.bool_]


class Situation(NamedTuple):
    """What there is to say while somebody is not localised; MAVs by index."""

    states: npt.NDArray[np.uint8]  # (N,)
    reasons: tuple[str, ...]  # (N,) "" for who is localised
    weights: Array  # (K,) of the joint hypotheses, best first, sum 1
    placed: Mask  # (K, N)
    poses: Array  # (K, N, 4) in the station's odometry frame


def situation(
    hypotheses: Hypotheses | None,
    verdict: Verdict | None,
    saturated: Mask | None,
    team: Mask,
    silent: Array,
    mute: Mask,
    ticks: int,
    ids: list[int],
) -> Situation:
    """Of the registration as it stands.

    Args:
        hypotheses: what is carried, if anything.
        verdict: on them.
        saturated: (N,) of whom more rivals are near than could be tested, if the leader was challenged lately.
        team: (N,) who is localised.
        silent: (N,) ticks for which nothing has been heard of each.
        mute: (N,) of whom no detection set has come in the ticks that are kept.
        ticks: that are kept.
        ids: (N,) MAV numbers.
    """
    mavs = len(team)
    states, reasons = np.full(mavs, SEARCHING, np.uint8), [""] * mavs
    relative: Array | None = None
    for j in range(mavs):
        if team[j]:
            states[j] = LOCALISED
        elif silent[j] > LEAST_TICKS:
            reasons[j] = f"nothing heard of it for {int(silent[j])} ticks"
        elif ticks < LEAST_TICKS:
            reasons[j] = f"{ticks} of {LEAST_TICKS} ticks heard that the search begins with"
        elif mute[j] and (verdict is None or hypotheses is None or not hypotheses.bank.placed[verdict.leader, j]):
            reasons[j] = f"none of its detection sets came in {ticks} ticks: it is found by what it sees, too"
        elif hypotheses is None or verdict is None:
            reasons[j] = "looking for a place that its sightings and those of it agree on"
        else:
            relative = hypotheses.relative() if relative is None else relative
            states[j], reasons[j] = _of(j, hypotheses, relative, verdict, saturated, ids)
    if hypotheses is None or verdict is None:
        return Situation(states, tuple(reasons), np.zeros(0), np.zeros((0, mavs), bool), np.zeros((0, mavs, 4)))
    weights = _weights(hypotheses, verdict.leader)
    order = np.argsort(-weights, kind="stable")[:MAX_HYPOTHESES]
    placed = hypotheses.bank.placed[order]
    poses = np.where(placed[..., None], hypotheses.bank.y[order, :-1], 0.0)
    return Situation(states, tuple(reasons), weights[order] / weights[order].sum(), placed, poses)


def _of(
    j: int, hypotheses: Hypotheses, relative: Array, verdict: Verdict, saturated: Mask | None, ids: list[int]
) -> tuple[int, str]:
    leader, ticks = verdict.leader, verdict.ticks
    if not hypotheses.bank.placed[leader, j]:
        return SEARCHING, "no place found that its sightings and those of it agree on"
    if verdict.rivalled[j] and ticks >= LEAST_TICKS:
        rival = int(verdict.rival[j])
        if not hypotheses.bank.placed[rival, j]:
            return AMBIGUOUS, f"one place fits, or none, after {ticks} ticks"
        words = f"two placements fit equally well after {int(verdict.common[rival])} ticks"
        other = _exchanged(j, relative[leader], relative[rival], hypotheses.bank.placed[leader])
        if other is None:
            return AMBIGUOUS, f"{words}; a motion of its own would tell them apart"
        return AMBIGUOUS, f"{words}, it and MAV {ids[other]} may be exchanged; a change of height by either would tell"
    if not verdict.fitting[j]:
        seen, sees = (f"{100 * share:.0f} %" for share in verdict.shares[:, j])
        return SEARCHING, f"a place is being tried: it is seen there {seen}, and sees the others {sees} of the time"
    if saturated is not None and saturated[j]:
        return (
            AMBIGUOUS,
            "more exchanges of identity fit equally well than can be tested; a motion of its own would tell",
        )
    if verdict.rivalled.any():
        return AMBIGUOUS, "its place is sure, but others may be exchanged, and what is seen of them taken for it"
    return SEARCHING, f"one placement leads after {ticks} ticks, it is being tested against exchanges of identity"


def _exchanged(j: int, leader: Array, rival: Array, placed: Mask) -> int | None:
    """On whose place (in the leading hypothesis) the rival puts j, both (N, 4) relative to the station."""
    apart = np.linalg.norm(leader[:, :3] - rival[j, :3], axis=-1)
    if apart[j] <= SAME_M:  # it is its yaw that is in question
        return None
    apart[~placed] = np.inf
    apart[j] = np.inf
    nearest = int(apart.argmin())
    return nearest if apart[nearest] < SAME_M else None


def _weights(hypotheses: Hypotheses, leader: int) -> Array:
    """Tempered by the random walk of the scores: raw ones look certain where nothing can be decided."""
    score, lead = hypotheses.recent(), hypotheses.lead(leader)
    walk = float(np.maximum(lead.walk, LEAST_SIGMA * np.sqrt(lead.ticks)).max())
    return np.asarray(np.maximum(np.exp((score - score.max()) / (1 + walk)), 1e-9))
