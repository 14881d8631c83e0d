"""Could the same places be occupied by others? Identity rivals of a hypothesis, as an assignment problem.

Given the places of a hypothesis, how likely MAV j's anonymous set is depends only on the place l and the yaw that j
has, not on who occupies the other places. With V[j, l] the log-likelihood of j's sets from place l, maximal over yaw,
that of a permutation pi is sum_j V[j, pi(j)]: its best solutions are exactly the rivals that exchange identities.
"""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.interface.frames import Array, compose, inverse, wrap
from agent.registration import views
from agent.registration.candidates import ELEVATION_GATE, RANGE_GATE
from agent.registration.window import Frame

Index = npt.NDArray[np.intp]

FRAMES = 5
PLACE_SIGMA_M = 0.02  # by which a hypothesis that has the identities wrong displaces its places
MATCHES = 12.0  # squared normalised residual below which a detection corrects the yaw
YAWS = 2  # of the best for a MAV and a place that are looked at more closely
NO_YAW = -1e3  # nats, where none fits any detection
BEAM = 300


class PlaceView(NamedTuple):
    V: Array  # (r, n) nats: MAV (row) at the place (column) of another
    yaw: Array  # (r, n) rad, the best one there, at the newest frame


class Rivals(NamedTuple):
    """Permutations of a hypothesis' MAVs over its places, best first; the hypothesis itself may be among them."""

    poses: Array  # (R, n, 4) in the station's odometry frame
    behind: Array  # (R,) nats behind the best
    best: float  # nats of the best
    known_to: float  # nats behind the best up to which all are found


class _Past(NamedTuple):
    """What one MAV heard in F frames, and what it would see from each of n places."""

    seen: Array  # (F, n, n, 3) of target (second n) from place (first n), common axes
    variances: Array  # (F, n, n, 3)
    sets: Array  # (F, M, 3) its detections
    turned: Array  # (F,) rad: its yaw then, less its yaw now


def place_view(
    config: AgentConfig, frames: list[Frame], mavs: npt.NDArray[np.intp], track: Array, P: Array
) -> Generator[float, None, PlaceView]:
    """Of the MAVs that occupy the places of a hypothesis, and of others; yields what it has cost.

    Args:
        config: the agent's.
        frames: F of them, oldest first.
        mavs: (r,) indices: of the n that occupy the places, the station's first, then of others.
        track: (F, n, 4) the poses that the hypothesis believed in at these frames.
        P: (n, 3, n, 3) covariance of their positions.
    """
    newest, n = frames[-1], track.shape[1]
    V, yaw = np.full((len(mavs), n), NO_YAW), np.tile(track[-1, :, 3], (len(mavs), 1))
    seen = views.predicted(track[:, :, None, :3], track[:, None, :, :3])
    blocks = P.transpose(0, 2, 1, 3)
    own = blocks[np.arange(n), np.arange(n)]
    G = views.axes(seen)
    variances = ((G @ (own[:, None] + own - blocks - blocks.swapaxes(0, 1))) * G).sum(-1)
    variances += 2 * PLACE_SIGMA_M**2 * (G * G).sum(-1) + views.noise(config.detector, seen[..., 0])
    most = max(f.spherical.shape[1] for f in frames)
    for row, j in enumerate(mavs):
        heard = [k for k, f in enumerate(frames) if f.heard[j]]
        if heard:
            sets = np.full((len(heard), most, 3), np.nan)
            for at, k in enumerate(heard):
                sets[at, : frames[k].spherical.shape[1]] = frames[k].spherical[j]
            turned = np.array([frames[k].odometry[j, 3] - newest.odometry[j, 3] for k in heard])
            tried = yield from _row(config, _Past(seen[heard], variances[heard], sets, turned), V[row], yaw[row])
            yield tried
    return PlaceView(V, yaw)


def _row(config: AgentConfig, past: _Past, V: Array, yaw: Array) -> Generator[float, None, float]:
    """Fills in one MAV's row of V and of the yaws; returns what it cost."""
    F, n, M = len(past.sets), len(V), past.sets.shape[1]
    place, psi = (np.concatenate(each) for each in zip(*(_yaws(past, f) for f in range(max(0, F - 2), F)), strict=True))
    if not len(place):
        return float(n * n * M)
    yield 1000.0 + 0.3 * len(place) * n * M
    newest = _Past(*(part[-1:] for part in past))
    best = _best_of_each(place, psi, _score(config, newest, place, psi), n)
    psi = _refined(past, place[best], psi[best])
    place = place[best]
    score = _score(config, past, place, psi)
    for k in np.argsort(score, kind="stable"):
        V[place[k]], yaw[place[k]] = score[k], psi[k]
    return 3000.0 + 1.6 * float(len(place) * F * n * M)


def _yaws(past: _Past, frame: int) -> tuple[Array, Array]:
    """Places and yaws (now) from which some detection of this frame would be some target."""
    seen, variances, z = past.seen[frame], past.variances[frame], past.sets[frame]
    agree = np.abs(z[:, 0] - seen[..., :1]) < RANGE_GATE * np.sqrt(variances[..., :1])
    agree &= np.abs(z[:, 2] - seen[..., 2:]) < ELEVATION_GATE * np.sqrt(variances[..., 2:])
    agree[np.arange(len(seen)), np.arange(len(seen))] = False
    place, target, m = agree.nonzero()
    return place, np.asarray(wrap(seen[place, target, 1] - z[m, 1] - past.turned[frame]))


def _score(config: AgentConfig, past: _Past, place: Index, psi: Array) -> Array:
    """(C,) nats: how well the sets agree with being seen from these places (C,) with these yaws (C,)."""
    seen, variances = past.seen[:, place], past.variances[:, place]  # (F, C, n, 3)
    yaw = np.broadcast_to((psi + past.turned[:, None])[..., None], seen.shape[:-1])
    agreement = views.log_seen(config.detector, seen, yaw, variances, past.sets[:, None, None])
    agreement[:, np.arange(len(place)), place] = 0.0
    return np.asarray(agreement.sum((0, 2)))


def _refined(past: _Past, place: Index, psi: Array) -> Array:
    """(C,) these yaws, corrected by the mean of what the matching detections say."""
    seen = past.seen[:, place]
    yaw = np.broadcast_to((psi + past.turned[:, None])[..., None], seen.shape[:-1])
    nu = views.residuals(seen, yaw, past.sets[:, None, None])
    matches = nu.square(past.variances[:, place]) < MATCHES
    matches[:, np.arange(len(place)), place] = False
    correction = np.where(matches, nu.azimuth, 0.0).sum((0, 2, 3))
    return np.asarray(psi - correction / np.maximum(matches.sum((0, 2, 3)), 1))


def _best_of_each(place: Array, psi: Array, score: Array, places: int) -> list[int]:
    """The best few distinct yaws of every place."""
    kept: list[int] = []
    count = [0] * places
    for k in np.argsort(-score, kind="stable"):
        same = (i for i in kept if place[i] == place[k] and abs(float(wrap(psi[i] - psi[k]))) < 0.05)
        if count[place[k]] < YAWS and next(same, None) is None:
            kept.append(int(k))
            count[place[k]] += 1
    return kept


def rivals(view: PlaceView, poses: Array, within: float) -> Rivals:
    """The permutations within so many nats of the best; `poses` (n, 4) are the places, the station's first."""
    n = len(view.V)
    deficit = view.V.max(1, keepdims=True) - view.V
    order = np.argsort(np.sort(deficit, axis=1)[:, min(1, n - 1)])[::-1]  # the surest rows first
    chosen, behind, known_to = np.zeros((1, 0), np.intp), np.zeros(1), np.inf
    free = np.ones((1, n), bool)
    bound = np.trace(deficit) + within  # the best is not behind the hypothesis itself
    for row in order:
        total = np.where(free, behind[:, None] + deficit[row], np.inf)
        ranked = np.argsort(total, axis=None, kind="stable")
        ranked = ranked[total.ravel()[ranked] <= bound]
        if len(ranked) > BEAM:
            known_to = min(known_to, float(total.ravel()[ranked[BEAM]]))
        parent, place = np.unravel_index(ranked[:BEAM], total.shape)
        chosen = np.column_stack([chosen[parent], place])
        behind = total[parent, place]
        free = free[parent].copy()
        free[np.arange(len(free)), place] = False
    where = np.empty_like(chosen)
    where[:, order] = chosen
    best = behind.min()
    keep = behind <= best + within
    where, behind = where[keep], behind[keep] - best
    placed = poses[where].copy()  # (R, n, 4)
    placed[..., 3] = view.yaw[np.arange(n), where]
    # The station is where its odometry says: everybody moves with it.
    moved = compose(np.repeat(compose(poses[0], inverse(placed[:, 0]))[:, None], n, axis=1), placed)
    return Rivals(moved, behind, float(view.V.max(1).sum()) - best, known_to - best)
