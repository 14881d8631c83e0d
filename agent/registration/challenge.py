"""Might others stand in the leading hypothesis' places? Which exchanges of identity have to be tested before a commit.

The rivals come from `places.py`, best first. Those near the best must all be tested by replay; a MAV of which more are
near than can be tested is *saturated*: the truth may be among the untested, so it is not committed, whatever its
margin.
"""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.interface.frames import Array, compose, inverse
from agent.registration import places
from agent.registration.candidates import Placement
from agent.registration.hypotheses import MARGIN, SAME_M, Hypotheses, elsewhere, from_station
from agent.registration.window import Frame

WITHIN, NEAR = 3.0, 18.0  # nats, times NEAR by the root of the frames: rivals that are looked at, that must be tested
MOST, FEW = 16, 4  # rivals tested; where they do not decide anything
FORBIDDEN = -1e6  # nats
LEAST_SEEN = 2  # placed MAVs, by one that does not look all around, before its place is believed
EACH = 2  # of them for every MAV at least
Mask = npt.NDArray[np.bool_]


class Challenge(NamedTuple):
    rivals: list[Placement]  # to be replayed
    saturated: Mask  # (N,)


def challenge(
    config: AgentConfig, hypotheses: Hypotheses, leader: int, frames: list[Frame], team: Mask
) -> Generator[float, None, Challenge]:
    """Of the leader at the newest of these frames; MAVs of the team (N,) are beyond doubt. Yields what it has cost."""
    mavs = np.flatnonzero(hypotheses.bank.placed[leader])
    N = hypotheses.bank.placed.shape[1]
    track = hypotheses.track[leader, -len(frames) :][:, mavs]
    known = np.isfinite(track[:, 0, 0])
    covariance = np.zeros((N, 4, N, 4))
    covariance[1:, :, 1:] = hypotheses.bank.P[leader].reshape(N, 4, N, 4)[:-1, :, :-1]
    among = covariance[mavs][:, :3][:, :, mavs][..., :3]
    past = [f for f, k in zip(frames, known, strict=True) if k]
    others = np.flatnonzero(~hypotheses.bank.placed[leader])
    view = yield from places.place_view(config, past, np.concatenate([mavs, others]), track[known], among)
    now, n = track[-1], len(mavs)
    near_by = NEAR * len(past) ** 0.5  # equals differ by a random walk
    found = _rivals(places.PlaceView(view.V[:n], view.yaw[:n]), now, np.flatnonzero(team[mavs]), WITHIN * near_by)
    yield 0.6 * places.BEAM * len(mavs) ** 2
    relative = from_station(found.poses)
    differs = _differs(from_station(now[None])[0], relative) & ~team[mavs]  # (R, n)
    tested = np.asarray(~differs.any(axis=1))
    own_behind = found.behind[tested].min(initial=np.inf)  # nats that the leader itself is behind the best
    for other in from_station(hypotheses.bank.y[hypotheses.bank.placed[:, mavs].all(axis=1)][:, mavs]):
        tested |= ~_differs(other, relative).any(axis=1)  # who is in the bank competes already
    chosen, tested = _chosen(found.behind, relative, differs, tested, near_by)
    near = (found.behind <= near_by) & ~tested
    saturated = np.zeros(N, bool)
    saturated[mavs] = differs[near].any(0) | (found.known_to < near_by)
    if len(others):  # one that has no place yet might be who stands there
        saturated[mavs] |= (view.V[n:] > np.diag(view.V[:n]) - near_by).any(axis=0) & ~team[mavs]
        if not config.detector.sees_all_around:
            saturated |= _seeing_few(config, hypotheses, leader, team)
    yield 5.0 * len(found.poses) * (1 + len(chosen))
    if saturated[mavs][~team[mavs]].all():  # nobody can be committed: only who may be better than the leader matters
        chosen = [r for r in chosen if found.behind[r] < own_behind - MARGIN][:FEW]
    return Challenge([_placement(N, mavs, found.poses[r]) for r in chosen], saturated)


def _seeing_few(config: AgentConfig, hypotheses: Hypotheses, leader: int, team: Mask) -> Mask:
    """(N,) who is placed, but by sightings that chance may have made: somebody without a place may be whom they are of.

    That a MAV is seen tells of its place, not who it is; that it sees another tells its yaw, and agrees in range and
    elevation by chance once in a hundred places. If the station itself sees few, nobody's place is known.
    """
    expected, explained = hypotheses.expected[leader], hypotheses.explained[leader]
    sees = ((expected >= 1) & (explained > 0.5 * config.detector.P_D * expected)).sum(axis=1)
    placed, few = hypotheses.bank.placed[leader], sees < LEAST_SEEN
    return np.asarray(placed & ~team & (few | (few[0] and team.sum() == 1)))


def _rivals(view: places.PlaceView, now: Array, fixed: npt.NDArray[np.intp], within: float) -> places.Rivals:
    """The permutations that leave those localised already (rows `fixed`, the station first) where the station sees
    them: with the station on another place, they may be on others, too, as in a mirrored line."""
    if len(fixed) == 1:
        return places.rivals(view, now, within)
    found = []
    for place in range(len(now)):
        turned = view.yaw[0, place] if place else now[0, 3]  # on its own place nothing has moved
        move = compose(np.append(now[place, :3], turned), inverse(now[0]))
        there = compose(np.repeat(move[None], len(fixed), axis=0), now[fixed])
        apart = np.linalg.norm(there[:, None, :3] - now[:, :3], axis=-1)
        to = apart.argmin(axis=1)
        if (apart.min(axis=1) > SAME_M).any() or len(set(to)) < len(to):
            continue
        V, yaw = view.V.copy(), view.yaw.copy()
        V[:, to] = V[fixed] = FORBIDDEN
        V[fixed, to], yaw[fixed, to] = view.V[fixed, to], there[:, 3]
        found.append(places.rivals(places.PlaceView(V, yaw), now, within))
    best = max(each.best for each in found)
    behind = np.concatenate([each.behind + best - each.best for each in found])
    order = np.argsort(behind, kind="stable")
    known_to = min(each.known_to + best - each.best for each in found)
    return places.Rivals(np.concatenate([each.poses for each in found])[order], behind[order], best, known_to)


def _chosen(behind: Array, relative: Array, differs: Mask, tested: Mask, near_by: float) -> tuple[list[int], Mask]:
    """Which rivals to test, and (R,) which are tested then: those alike, too.

    Args:
        behind: (R,) nats that they are behind the best, ascending.
        relative: (R, n, 4) their poses in the station's body frame.
        differs: (R, n) whom they place elsewhere than the leader.
        tested: (R,) which need not be.
        near_by: nats within which all must be.
    """
    chosen: list[int] = []
    tested, count = tested.copy(), differs[tested].sum(axis=0)
    for r in np.flatnonzero(~tested):
        if len(chosen) == MOST:
            break
        if not tested[r] and (behind[r] <= near_by or (count[differs[r]] < EACH).any()):
            chosen.append(int(r))
            count += differs[r]
            tested |= ~_differs(relative[r], relative).any(axis=1)
    return chosen, tested


def _differs(leader: Array, relative: Array) -> Mask:
    """(R, n) whether these (R, n, 4) place a MAV elsewhere than the leader (n, 4)."""
    every = np.ones(len(leader), bool)
    return elsewhere(leader[None], every, relative, every)


def _placement(mavs: int, placed: npt.NDArray[np.intp], poses: Array) -> Placement:
    made = Placement(np.zeros((mavs, 4)), np.zeros((mavs, 4, 4)), np.zeros(mavs, bool))
    made.poses[placed], made.placed[placed] = poses, True
    return made
