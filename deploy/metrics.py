"""How good was a run? Errors, consistency and agreement as pure functions on arrays of a recording.

Index k is the tick, i the agent (the station), j whom it is about. Poses (..., 4) are x y z in m and yaw in rad,
gravity-aligned. `absolute` (K, N, N, 4) is the pose of j in the frame that stays where i's odometry began, `relative`
(K, N, N, 4) that of j in the body frame of i, `estimates` (K, N, N, 4) that of j in i's odometry frame, which drifts
away from where it began. What is unknown is NaN and counts nowhere.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array, compose, inverse, relative_pose, rotate_z, wrap
from agent.interface.messages import LOCALISED

Mask = npt.NDArray[np.bool_]
States = npt.NDArray[np.uint8]

SETTLING_S = 2.0  # an estimate is scored from so long after its MAV was called localised
FINAL_S = 2.0  # "final" is the end of the run, so long


class Errors(NamedTuple):
    """Estimated minus true; NaN for a MAV about itself and where there is no estimate."""

    position_m: Array  # (K, N, N) length of the difference
    yaw_rad: Array  # (K, N, N) absolute value


class Score(NamedTuple):
    """NaN where nothing was to be scored."""

    rmse_m: float
    rmse_deg: float
    final_rmse_m: float
    final_rmse_deg: float
    max_m: float


def odometry_origins(true_poses: Array, odometry: Array) -> Array:
    """(N, 4) where each odometry frame began, in world: both inputs (K, N, 4).

    Recorded odometry need not begin at zero, so the origin is the first true pose less the odometry of that tick.
    """
    both = np.isfinite(np.concatenate([true_poses, odometry], axis=-1)).all(axis=-1)  # (K, N)
    first, mavs = both.argmax(axis=0), np.arange(both.shape[1])
    origins = compose(true_poses[first, mavs], inverse(odometry[first, mavs]))
    return np.where(both.any(axis=0)[:, None], origins, np.nan)


def origins_of_lives(true_poses: Array, odometry: Array, incarnations: npt.NDArray[np.int64]) -> Array:
    """(K, N, 4) the same, where who is started anew has an odometry frame of its own: incarnations (K, N)."""
    origins = np.full(true_poses.shape, np.nan)
    for incarnation in np.unique(incarnations):
        mine = incarnations == incarnation
        origins[mine] = np.broadcast_to(
            odometry_origins(true_poses, np.where(mine[..., None], odometry, np.nan)), origins.shape
        )[mine]
    return origins


def absolute_from_world(origins: Array, poses_world: Array) -> Array:
    """(K, N, N, 4) poses (K, N, 4) of all MAVs as seen from where each one's odometry began, (N, 4) or (K, N, 4)."""
    return relative_pose(origins[..., :, None, :], poses_world[:, None, :, :])


def naive_absolute(origins: Array, odometry: Array) -> Array:
    """(K, N, N, 4) the baseline: the known initial configuration, and each MAV's odometry (K, N, 4) since."""
    return absolute_from_world(origins, compose(origins, odometry))


def dead_reckoned(true_relative: Array, odometry: Array, since: npt.NDArray[np.int64]) -> Array:
    """(K, N, N, 4) the true pose of j in the body of i at tick `since` (K, N, N), moved on by the odometry of both."""
    i, j = np.indices(since.shape[1:])
    now = np.arange(len(since))[:, None, None]
    moved_i = relative_pose(odometry[since, i], odometry[now, i])
    moved_j = relative_pose(odometry[since, j], odometry[now, j])
    return relative_pose(moved_i, compose(true_relative[since, i, j], moved_j))


def relative_from_absolute(absolute: Array) -> Array:
    """(K, N, N, 4) poses of j in the body frame of i, as i believes both to be: from `estimates` just as well."""
    mavs = np.arange(absolute.shape[1])
    own = absolute[:, mavs, mavs]
    return relative_pose(own[:, :, None, :], absolute)


def errors(estimated: Array, true: Array) -> Errors:
    """Of poses (K, N, N, 4), absolute or relative."""
    position = np.linalg.norm(estimated[..., :3] - true[..., :3], axis=-1)
    yaw = np.abs(wrap(estimated[..., 3] - true[..., 3]))
    mavs = np.arange(position.shape[1])
    position[:, mavs, mavs] = np.nan
    yaw[:, mavs, mavs] = np.nan
    return Errors(position, yaw)


def settled(since_s: Array, time_s: Array) -> Mask:
    """(K, N, N) the pairs and ticks that are scored, from when j was called localised, (N, N) or (K, N, N)."""
    return np.asarray(time_s[:, None, None] >= since_s + SETTLING_S - 1e-9)


def score(error: Errors, scored: Mask, time_s: Array) -> Score:
    """Over all pairs and ticks where `scored`."""
    position = np.where(scored, error.position_m, np.nan)
    yaw = np.rad2deg(np.where(scored, error.yaw_rad, np.nan))
    final = time_s > time_s[-1] - FINAL_S if len(time_s) else np.zeros(0, bool)
    return Score(
        rms(position),
        rms(yaw),
        rms(position[final]),
        rms(yaw[final]),
        float(np.fmax.reduce(position, axis=None, initial=np.nan)),
    )


def nearest_m(positions: Array) -> float:
    """Least distance of any two MAVs at any tick, from (K, N, 3) places; NaN if there are no two."""
    i, j = np.triu_indices(positions.shape[1], 1)
    apart = np.linalg.norm(positions[:, i] - positions[:, j], axis=-1)
    return float(np.fmin.reduce(apart, axis=None, initial=np.nan))


def rms(values: Array) -> float:
    """Root mean square of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def rms_over_pairs(values: Array) -> Array:
    """(K,) root mean square over the finite pairs of each tick of (K, N, N)."""
    finite = np.isfinite(values)
    count = finite.sum(axis=(1, 2))
    total = np.where(finite, values, 0.0) ** 2
    return np.where(count > 0, np.sqrt(total.sum(axis=(1, 2)) / np.maximum(count, 1)), np.nan)


def team_sum_of_squares(values: Array) -> Array:
    """(K,) the paper's E (of absolute errors) and Er (of relative ones): sum over j of the squares, mean over i."""
    finite = np.isfinite(values)
    agents = finite.any(axis=2).sum(axis=1)
    total = np.where(finite, values, 0.0) ** 2
    return np.where(agents > 0, total.sum(axis=(1, 2)) / np.maximum(agents, 1), np.nan)


def nees(estimates: Array, covariances: Array, true_relative: Array) -> Array:
    """(K, N, N) squared Mahalanobis length of the relative error of each pair, 4 degrees of freedom.

    The covariances (K, N, N, 4, 4) are those of `estimates`; in i's odometry frame i's own pose is nearly exact, so
    turned into i's body they are those of the relative pose. Infinite where one is not positive definite.
    """
    mavs = np.arange(estimates.shape[1])
    difference = relative_from_absolute(estimates) - true_relative
    difference[..., 3] = wrap(difference[..., 3])
    own_yaw = estimates[:, mavs, mavs, 3]
    # Turning the error into the odometry frame is the same as turning the covariance into the body, and cheaper.
    difference[..., :3] = rotate_z(own_yaw[:, :, None], difference[..., :3])
    numbers = np.concatenate([difference[..., None], covariances], axis=-1)
    known = np.isfinite(numbers).all(axis=(-1, -2))
    known[:, mavs, mavs] = False
    result = np.full(known.shape, np.nan)
    P, e = covariances[known], difference[known]
    values = np.full(len(e), np.inf)
    sound = np.linalg.eigvalsh(P)[:, 0] > 0
    values[sound] = np.einsum("pi,pi->p", e[sound], np.linalg.solve(P[sound], e[sound][..., None])[..., 0])
    result[known] = values
    return result


def anees(nees_of_pairs: Array, scored: Mask) -> float:
    """Average over all scored pairs and ticks, per degree of freedom: 1 is consistent, more is overconfident."""
    values = nees_of_pairs[scored & ~np.isnan(nees_of_pairs)]
    return float(np.mean(values) / 4) if values.size else float("nan")


class Band(NamedTuple):
    low: float
    high: float


def anees_band(runs: int, mavs: int) -> Band:
    """Where the mean ANEES of so many runs of a consistent estimator lies with 95 % probability.

    Two-sided chi-square with 4 (N - 1) degrees of freedom a run: errors of one run are strongly correlated in time,
    so that a run counts as one draw of the team's state, however long it is.
    """
    from scipy.special import gammaincinv  # scipy.stats takes five seconds to import

    k = runs * 4 * max(mavs - 1, 1)
    return Band(*(float(2 * gammaincinv(k / 2, p) / k) for p in (0.025, 0.975)))


def nis_inside(innovations: Array) -> float:
    """Share of the innovations inside their 95 % gate, from (K, N, 2) counts; NaN without any."""
    total, inside = np.nansum(innovations, axis=(0, 1))
    return float(inside / total) if total else float("nan")


def disagreement_m(estimates: Array, states: States) -> float:
    """95th percentile over time of the largest difference between two agents' beliefs of one relative position.

    At each tick over all pairs (a, b) and all agents that call both localised; NaN if never two do.
    """
    N = estimates.shape[1]
    largest = []
    for k in range(len(estimates)):
        called = states[k] == LOCALISED
        called[np.arange(N), np.arange(N)] = True
        both = called[:, :, None] & called[:, None, :]  # (agent, a, b)
        believed = relative_pose(estimates[k, :, :, None], estimates[k, :, None, :])[..., :3]  # of b in a's body
        belief = np.where(both[..., None], believed, np.nan).reshape(N, N * N, 3)
        apart = np.full(N * N, np.nan)
        for i in range(N - 1):
            gap = ((belief[i + 1 :] - belief[i]) ** 2).sum(-1)
            apart = np.fmax(apart, np.fmax.reduce(gap, axis=0))
        if np.isfinite(apart).any():
            largest.append(np.sqrt(np.nanmax(apart)))
    return float(np.percentile(largest, 95)) if largest else float("nan")
