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
from agent.registration.window import Frame

Index = npt.NDArray[np.intp]

FRAMES = 5
PLACE_SIGMA_M = 0.02  # by which a hypothesis that has the identities wrong displaces its places
AGREES, MATCHES = 36.0, 12.0  # squared normalised residuals below which a detection counts, and proposes a yaw
LOOKS = 24  # directions in which it may look, whatever it sees, where it does not look all around
YAWS, SAME_YAW_RAD = 2, 0.05  # of the best for a MAV and a place that are looked at more closely, so far apart
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


class _Scene(NamedTuple):
    """What a MAV would see in F frames from each of n places."""

    seen: Array  # (F, n, n, 3) of target (second n) from place (first n), common axes
    variances: Array  # (F, n, n, 3)
    turned: Array  # (F,) rad: its yaw then, less its yaw now


class _Hits(NamedTuple):
    """One MAV's detections that agree, in range and elevation, with a target seen from a place; sorted by place."""

    first: Index  # (n + 1,) where each place's begin
    place: Index  # (H,) of n
    term: Index  # (H,) frame and target, as one index of F n
    frame: Index  # (H,)
    yaw: Array  # (H,) rad of the MAV now, with which the azimuths would agree, too
    lever: Array  # (H,) cos of the elevation
    variance: Array  # (H,) of the azimuth's residual
    square: Array  # (H,) normalised squared residual of range and elevation
    peak: Array  # (H,) of the density against that of false detections


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
    for row, j in enumerate(mavs):
        heard = [k for k, f in enumerate(frames) if f.heard[j]]
        if heard:
            sets = [frames[k].spherical[j] for k in heard]
            turned = np.array([frames[k].odometry[j, 3] - newest.odometry[j, 3] for k in heard])
            tried = _row(config, _Scene(seen[heard], variances[heard], turned), sets, V[row], yaw[row])
            yield 2500.0 + 1.5 * tried
    return PlaceView(V, yaw)


def _row(config: AgentConfig, scene: _Scene, sets: list[Array], V: Array, yaw: Array) -> int:
    """Fills in one MAV's row of V (n,) and of the yaws (n,) from its F sets (M, 3); returns how many hits it tried."""
    hits, F, n = _hits(config, scene, sets), len(sets), len(V)
    near = np.flatnonzero((hits.frame >= F - 2) & (hits.square < MATCHES))
    place, psi = hits.place[near], hits.yaw[near]
    if not config.detector.sees_all_around:  # it may look away from all of them
        place = np.concatenate([place, np.repeat(np.arange(n), LOOKS)])
        psi = np.concatenate([psi, np.tile(np.linspace(-np.pi, np.pi, LOOKS, endpoint=False), n)])
    yaws = len(place)
    if not yaws:
        return len(hits.place)
    newest = hits.frame == F - 1
    before = np.concatenate([[0], np.cumsum(newest)])
    last = _Hits(before[hits.first], *(part[newest] for part in hits[1:]))
    best = _best_of_each(place, psi, _score(config, scene, last, place, psi, [F - 1]), n)
    psi = _refined(hits, place[best], psi[best])
    place = place[best]
    score = _score(config, scene, hits, place, psi, list(range(F)))
    for k in np.argsort(score, kind="stable"):
        V[place[k]], yaw[place[k]] = score[k], psi[k]
    return len(hits.place) + yaws * len(last.place) // n


def _hits(config: AgentConfig, scene: _Scene, sets: list[Array]) -> _Hits:
    F, n = scene.seen.shape[:2]
    z = np.full((F, max(map(len, sets)), 3), np.nan)
    for k, each in enumerate(sets):
        z[k, : len(each)] = each
    off_range = (z[:, None, None, :, 0] - scene.seen[..., :1]) ** 2 / scene.variances[..., :1]
    off_elevation = (z[:, None, None, :, 2] - scene.seen[..., 2:]) ** 2 / scene.variances[..., 2:]
    square = off_range + off_elevation
    agree = square < AGREES  # NaN compares false
    agree[:, np.arange(n), np.arange(n)] = False
    place, frame, target, m = agree.transpose(1, 0, 2, 3).nonzero()
    pair = (frame, place, target)
    variances, detected = scene.variances[pair], z[frame, m]
    clutter = views.clutter(config.detector, detected[:, 0])
    return _Hits(
        np.searchsorted(place, np.arange(n + 1)),
        place,
        frame * n + target,
        frame,
        scene.seen[pair][:, 1] - detected[:, 1] - scene.turned[frame],
        np.cos(scene.seen[pair][:, 2]),
        variances[:, 1],
        square[frame, place, target, m],
        1.0 / (np.sqrt((2 * np.pi) ** 3 * variances.prod(-1)) * clutter),
    )


class _Tried(NamedTuple):
    """Every hit of every yaw's place, one after the other."""

    by: Index  # (T,) the yaw, of C
    hit: Index  # (T,)
    off: Array  # (T,) rad times cos(elevation) by which the azimuths differ

    @staticmethod
    def of(hits: _Hits, place: Index, psi: Array) -> "_Tried":
        counts = hits.first[place + 1] - hits.first[place]
        by = np.repeat(np.arange(len(place)), counts)
        hit = np.arange(len(by)) + np.repeat(hits.first[place] - (np.cumsum(counts) - counts), counts)
        off = psi[by] - hits.yaw[hit]
        off -= 2 * np.pi * np.rint(off / (2 * np.pi))
        return _Tried(by, hit, off * hits.lever[hit])


def _score(config: AgentConfig, scene: _Scene, hits: _Hits, place: Index, psi: Array, frames: list[int]) -> Array:
    """(C,) nats: how well the sets of these frames agree with these yaws (C,) at these places (C,)."""
    F, n = scene.seen.shape[:2]
    tried = _Tried.of(hits, place, psi)
    square = hits.square[tried.hit] + tried.off**2 / hits.variance[tried.hit]
    density = np.exp(-0.5 * square) * hits.peak[tried.hit]
    agreement = np.bincount(tried.by * (F * n) + hits.term[tried.hit], density, len(place) * F * n).reshape(-1, F, n)
    yaw = np.broadcast_to((psi[:, None] + scene.turned[frames])[..., None], (len(place), len(frames), n))
    seen = scene.seen[np.array(frames)[None, :], place[:, None]]
    P_D = views.detection_probability(config.detector, seen, yaw).copy()
    P_D[np.arange(len(place)), :, place] = 0.0
    return np.asarray(np.log(1 - P_D + P_D * agreement[:, frames]).sum((1, 2)))


def _refined(hits: _Hits, place: Index, psi: Array) -> Array:
    """(C,) these yaws, corrected by the mean of what the matching detections say."""
    tried = _Tried.of(hits, place, psi)
    matches = hits.square[tried.hit] + tried.off**2 / hits.variance[tried.hit] < MATCHES
    by, off = tried.by[matches], tried.off[matches]
    count = np.bincount(by, minlength=len(place))
    return np.asarray(psi - np.bincount(by, off, len(place)) / np.maximum(count, 1))


def _best_of_each(place: Index, psi: Array, score: Array, places: int) -> list[int]:
    """The best few distinct yaws of every place."""
    kept: list[int] = []
    order = np.argsort(-score, kind="stable")
    for each in range(places):
        left = order[place[order] == each]
        for _ in range(YAWS):
            if not len(left):
                break
            kept.append(int(left[0]))
            left = left[np.abs(wrap(psi[left] - psi[left[0]])) >= SAME_YAW_RAD]
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
    if not len(chosen):  # what the beam has kept ends beyond the bound, what it has dropped is not known
        return Rivals(poses[None].copy(), np.zeros(1), float(np.trace(deficit)), 0.0)
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
