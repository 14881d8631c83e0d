"""Which joint placements of the team are worth a closer look? The pairwise field, and a beam search over it.

How well MAV i at one candidate sees MAV j at another, and back, needs no identities: it is `views.log_seen`. Summed
over all pairs of a joint placement it ranks the truth first or nearly so, before any refinement.
"""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.interface.frames import Array, range_and_bearing
from agent.registration import views
from agent.registration.candidates import Candidates, Placement, candidates
from agent.registration.window import Frame, carried

Index = npt.NDArray[np.intp]

FIELD_FRAMES = 4  # over which the field is taken
PLACING_COSTS = 4.0  # nats a frame that a placement must be worth: clutter, too, finds some agreement
TOO_CLOSE_M, TOO_CLOSE = 0.25, -1000.0  # two MAVs cannot be in one place
BEAM = 300
WITHIN, CONTESTED = 60.0, 10.0  # nats a frame of the best: what is looked at, what is nearly as good
BRANCHES = 4  # of the best placements, how many are completed
WEAK = 0.5  # of the median agreement: a MAV below is looked for again


class Proposal(NamedTuple):
    score: float  # nats a frame
    placement: Placement
    agreement: Array  # (N,) nats a frame that each MAV's placement shares in


class Proposed(NamedTuple):
    placements: list[Placement]  # best first
    contested: bool  # so many are nearly as good as the best that the truth may be any of them, or none


def propose(
    config: AgentConfig, frames: list[Frame], base: Placement, missing: list[int], most: int
) -> Generator[float, None, Proposed]:
    """The best joint placements (at most `most`, best first) that add MAVs in `missing` to those of `base`.

    A MAV that the station did not see, and was not seen by, often enough has no candidate, or wrong ones only. So the
    best placements are completed: MAVs that they leave out, or that agree far less than the others, are looked for
    from all MAVs placed. Yields what it has just cost, in detection-target pairs.
    """
    found = yield from _extended(config, frames, base, missing, most)
    every = list(found)
    for proposal in found[:BRANCHES]:
        placed, agreement = proposal.placement.placed, proposal.agreement
        weak = placed & ~base.placed & (agreement < WEAK * np.median(agreement[placed]))
        rest = Placement(proposal.placement.poses, proposal.placement.covariances, placed & ~weak)
        left = [j for j in missing if not rest.placed[j]]
        if left and rest.placed.sum() > base.placed.sum():
            more = yield from _extended(config, frames, rest, left, 2)
            without = proposal.score - float((agreement[weak] - PLACING_COSTS).sum())
            every += [m._replace(score=without + m.score) for m in more if m.score > 0]
    every.sort(key=lambda each: -each.score)
    contested = sum(each.score > every[0].score - CONTESTED for each in every) > 1 + most // 2
    return Proposed([proposal.placement for proposal in every[:most]], contested)


def _extended(
    config: AgentConfig, frames: list[Frame], base: Placement, missing: list[int], most: int
) -> Generator[float, None, list[Proposal]]:
    """Best first; `base` itself, at 0, if nothing is better."""
    found = yield from candidates(config, frames, base, missing)
    bases = np.flatnonzero(base.placed)
    nodes = Candidates(
        np.concatenate([bases, found.mav]),
        np.concatenate([base.poses[bases], found.poses]),
        np.concatenate([base.covariances[bases], found.covariances]),
    )
    field = yield from _field(config, frames, nodes)
    first = len(bases)
    unary = field[first:, :first].sum(1) - PLACING_COSTS
    chosen, scores = _beam(found.mav, unary, field[first:, first:], missing)
    yield 0.7 * float(BEAM * len(found.mav))
    keep = (scores > scores[0] - WITHIN).nonzero()[0][:most]
    return [_proposal(base, nodes, field, float(scores[h]), chosen[h][chosen[h] >= 0] + first) for h in keep]


def _proposal(base: Placement, nodes: Candidates, field: Array, score: float, chosen: Index) -> Proposal:
    made = Placement(base.poses.copy(), base.covariances.copy(), base.placed.copy())
    mav = nodes.mav[chosen]
    made.poses[mav], made.covariances[mav], made.placed[mav] = nodes.poses[chosen], nodes.covariances[chosen], True
    used = np.concatenate([np.arange(base.placed.sum()), chosen])
    among = field[np.ix_(used, used)]
    agreement = np.zeros(len(base.placed))
    agreement[nodes.mav[used]] = np.where(np.isfinite(among), among, 0.0).sum(1)
    return Proposal(score, made, agreement)


def _field(config: AgentConfig, frames: list[Frame], nodes: Candidates) -> Generator[float, None, Array]:
    """(C, C) mean over frames of how well each two nodes see each other, nats; -inf within one MAV."""
    detector, newest = config.detector, frames[-1]
    mav, C = nodes.mav, len(nodes.mav)
    lines = nodes.poses[None, :, :3] - nodes.poses[:, None, :3]
    variances = _variances(config, nodes, lines)
    yield 3.0 * C * C
    field, weight = np.zeros((C, C)), np.zeros((C, C))
    recent = [f for f in frames if f.heard.any()][-FIELD_FRAMES:]
    for frame in recent:
        there = carried(nodes.poses, newest.odometry[mav], frame.odometry[mav])
        heard = np.flatnonzero(frame.heard[mav])
        for some in np.array_split(heard, max(1, len(heard) * C * frame.spherical.shape[1] // 40_000)):
            spherical = views.predicted(there[some, None, :3], there[None, :, :3])
            yaw = np.broadcast_to(there[some, 3][:, None], spherical.shape[:2])
            sets = frame.spherical[mav[some]][:, None]
            field[some] += views.log_seen(detector, spherical, yaw, variances[some], sets)
            weight[some] += 1.0
            yield 1000.0 + 0.2 * spherical[..., 0].size * sets.shape[2]
    field /= np.maximum(weight, 1.0)
    field += field.T
    field[np.linalg.norm(lines, axis=-1) < TOO_CLOSE_M] += TOO_CLOSE
    field[mav[:, None] == mav] = -np.inf
    return field


def _variances(config: AgentConfig, nodes: Candidates, lines: Array) -> Array:
    """(C, C, 3) of what station (row) sees of target (column): the sensor's, and that of both candidates."""
    spherical = range_and_bearing(lines)
    G = views.axes(spherical)
    position = nodes.covariances[:, :3, :3]
    both = position[:, None] + position[None]
    variances = ((G @ both) * G).sum(-1)
    variances[..., 1] += nodes.covariances[:, None, 3, 3]
    return np.asarray(variances + views.noise(config.detector, spherical[..., 0]))


def _beam(mav: Index, unary: Array, pair: Array, missing: list[int]) -> tuple[Index, Array]:
    """The best choices of one candidate or none (-1) per MAV, (H, len(missing)), and their scores (H,), best first."""
    C = len(mav)
    pair = np.pad(pair, ((0, 0), (0, 1)))  # the last column is "not placed"
    own = [np.flatnonzero(mav == j) for j in missing]
    order = sorted((k for k in range(len(missing)) if len(own[k])), key=lambda k: len(own[k]))
    chosen = np.full((1, len(missing)), C)
    scores = np.zeros(1)
    for k in order:
        gain = unary[own[k], None] + pair[own[k]][:, chosen].sum(-1)  # (candidates, beam)
        options = np.concatenate([scores[None], scores + gain])
        best = np.argsort(-options, axis=None, kind="stable")[:BEAM]
        best = best[np.isfinite(options.ravel()[best])]
        option, parent = np.unravel_index(best, options.shape)
        chosen = chosen[parent]
        chosen[:, k] = np.concatenate([[C], own[k]])[option]
        scores = options[option, parent]
    return np.where(chosen == C, -1, chosen), scores
