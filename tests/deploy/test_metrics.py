"""Do the metrics say what they should of cases that are worked out by hand?"""

import dataclasses

import numpy as np
import pytest

from agent.interface.frames import compose, inverse, relative_pose, rotate_z
from agent.interface.messages import LOCALISED, SEARCHING
from deploy import commits, metrics

K, N = 40, 4
TIME_S = np.arange(K) / 10.0


@dataclasses.dataclass
class Flight:
    """A random flight with odometry that does not begin at zero, and perfect beliefs."""

    truth: np.ndarray
    odometry: np.ndarray
    origins: np.ndarray
    absolute: np.ndarray


@pytest.fixture
def flight() -> Flight:
    rng = np.random.default_rng(3)
    truth = np.cumsum(rng.normal(0, 0.1, (K, N, 4)), axis=0) + rng.normal(0, 3, (N, 4))
    truth[..., 3] = (truth[..., 3] + np.pi) % (2 * np.pi) - np.pi
    origins = rng.normal(0, 2, (N, 4))
    odometry = relative_pose(origins[None], truth)
    return Flight(truth, odometry, origins, metrics.absolute_from_world(origins, truth))


def always() -> np.ndarray:
    return np.ones((K, N, N), bool)


def test_perfect_odometry_has_its_origins_found_and_no_naive_error(flight: Flight) -> None:
    origins = metrics.odometry_origins(flight.truth, flight.odometry)
    np.testing.assert_allclose(rotate_z(origins[:, 3], np.eye(3)[:1]), rotate_z(flight.origins[:, 3], np.eye(3)[:1]))
    np.testing.assert_allclose(origins[:, :3], flight.origins[:, :3], atol=1e-12)
    naive = metrics.naive_absolute(origins, flight.odometry)
    score = metrics.score(metrics.errors(naive, flight.absolute), always(), TIME_S)
    assert max(score) < 1e-9


def test_relative_poses_do_not_depend_on_the_odometry_frame(flight: Flight) -> None:
    expected = relative_pose(flight.truth[:, :, None], flight.truth[:, None, :])
    found = metrics.relative_from_absolute(flight.absolute)
    np.testing.assert_allclose(found[..., :3], expected[..., :3], atol=1e-9)
    assert metrics.rms(metrics.errors(found, expected).yaw_rad) < 1e-9


def test_a_known_offset_of_one_mav(flight: Flight) -> None:
    """All agents put MAV 2 by 0.3 m too far up and 5 deg too far left: 3 pairs of 12, itself not counted."""
    believed = flight.absolute.copy()
    believed[:, [0, 2, 3], 1] += [0, 0, 0.3, np.deg2rad(5)]
    error = metrics.errors(believed, flight.absolute)
    score = metrics.score(error, always(), TIME_S)
    assert score.rmse_m == pytest.approx(0.3 * np.sqrt(3 / 12))
    assert score.rmse_deg == pytest.approx(5 * np.sqrt(3 / 12))
    assert score.max_m == pytest.approx(0.3)
    np.testing.assert_allclose(metrics.team_sum_of_squares(error.position_m), 0.3**2 * 3 / 4)
    np.testing.assert_allclose(metrics.rms_over_pairs(error.position_m), 0.3 * np.sqrt(3 / 12))


def test_final_is_the_last_two_seconds(flight: Flight) -> None:
    believed = flight.absolute.copy()
    others = ~np.eye(N, dtype=bool)
    believed[-20:, others, 0] += 0.5
    score = metrics.score(metrics.errors(believed, flight.absolute), always(), TIME_S)
    assert score.final_rmse_m == pytest.approx(0.5)
    assert score.rmse_m == pytest.approx(0.5 * np.sqrt(20 / K))


def test_the_nearest_are_the_nearest_two_at_one_time() -> None:
    at = np.array([[[0.0, 0, 0], [5, 0, 0], [0, 3, 4]], [[9, 0, 0], [5, 0, 3], [np.nan] * 3]])
    assert metrics.nearest_m(at) == pytest.approx(5.0)
    at[1, 2] = 9, 2, 0
    assert metrics.nearest_m(at) == pytest.approx(2.0)
    assert np.isnan(metrics.nearest_m(at[:, :1]))
    assert np.isnan(metrics.nearest_m(at[:0]))


def test_yaw_errors_go_the_short_way_round(flight: Flight) -> None:
    true = flight.absolute.copy()
    true[..., 3] = np.pi - 0.01
    believed = true.copy()
    believed[..., 3] = -np.pi + 0.01
    assert metrics.rms(metrics.errors(believed, true).yaw_rad) == pytest.approx(0.02)


def test_scored_from_two_seconds_after_localisation_on() -> None:
    states = np.full((K, 2, 2), SEARCHING, np.uint8)
    states[5:8, 0, 1] = LOCALISED  # and never again: what it says from then on still counts
    since_s = commits.localised_since(states, TIME_S)
    assert since_s[0, 1] == 0.5
    assert np.isnan(since_s[1, 0])
    scored = metrics.settled(since_s, TIME_S)
    assert np.flatnonzero(scored[:, 0, 1]).tolist() == list(range(25, K))
    assert not scored[:, 1, 0].any()


def test_missing_ticks_and_agents_count_nowhere(flight: Flight) -> None:
    believed = flight.absolute.copy()
    believed[:, :, 1, 0] += 0.2
    believed[10:, 2] = np.nan  # agent 3 was killed
    believed[5] = np.nan  # nothing of this tick was recorded
    error = metrics.errors(believed, flight.absolute)
    score = metrics.score(error, always(), TIME_S)
    assert score.max_m == pytest.approx(0.2)
    assert np.isnan(metrics.rms_over_pairs(error.position_m)[5])
    empty = metrics.score(error, ~always(), TIME_S)
    assert all(np.isnan(value) for value in empty)


def test_origin_is_taken_where_truth_and_odometry_are_both_there_first(flight: Flight) -> None:
    odometry = flight.odometry.copy()
    odometry[:3, 1] = np.nan
    odometry[:, 3] = np.nan
    origins = metrics.odometry_origins(flight.truth, odometry)
    np.testing.assert_allclose(origins[1, :3], flight.origins[1, :3], atol=1e-12)
    assert np.isnan(origins[3]).all()


def drawn(flight: Flight, seed: int, claimed: float) -> tuple[np.ndarray, np.ndarray]:
    """Beliefs with errors drawn from one random covariance per pair, which is claimed to be so many times larger."""
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 0.1, (N, N, 4, 4))
    covariance = root @ root.swapaxes(-1, -2) + 1e-4 * np.eye(4)
    noise = np.einsum("ijab,kijb->kija", np.linalg.cholesky(covariance), rng.standard_normal((K, N, N, 4)))
    noise[:, np.arange(N), np.arange(N)] = 0  # in its own odometry frame an agent knows itself
    covariances = np.broadcast_to(covariance * claimed, (K, N, N, 4, 4))
    return flight.absolute + noise, covariances


@pytest.mark.parametrize(("claimed", "consistent"), [(1.0, True), (0.8, False), (1.25, False)])
def test_anees_of_exactly_drawn_errors_is_near_one_and_of_others_is_not(
    flight: Flight, claimed: float, consistent: bool
) -> None:
    true_relative = metrics.relative_from_absolute(flight.absolute)
    values = []
    for seed in range(10):
        believed, covariances = drawn(flight, seed, claimed)
        values.append(metrics.anees(metrics.nees(believed, covariances, true_relative), always()))
    # Here every tick of every agent is a draw of its own.
    band = metrics.anees_band(10 * K * N, N)
    assert (band.low < np.mean(values) < band.high) == consistent
    assert np.mean(values) == pytest.approx(1 / claimed, rel=0.05)


def test_nees_against_the_plain_formula(flight: Flight) -> None:
    """The covariance of the relative pose is that in the odometry frame, turned by minus the agent's yaw."""
    believed, covariances = drawn(flight, 1, 1.0)
    true_relative = metrics.relative_from_absolute(flight.absolute)
    found = metrics.nees(believed, covariances, true_relative)
    k, i, j = 7, 2, 0
    turn = np.eye(4)
    turn[:3, :3] = rotate_z(-believed[k, i, i, 3], np.eye(3)).T
    P = turn @ covariances[k, i, j] @ turn.T
    e = relative_pose(believed[k, i, i], believed[k, i, j]) - true_relative[k, i, j]
    e[3] = (e[3] + np.pi) % (2 * np.pi) - np.pi
    assert found[k, i, j] == pytest.approx(e @ np.linalg.inv(P) @ e)
    assert np.isnan(found[:, range(N), range(N)]).all()


def test_a_covariance_that_is_none_makes_anees_infinite(flight: Flight) -> None:
    believed, covariances = drawn(flight, 1, 1.0)
    broken = covariances.copy()
    broken[3, 0, 1] = np.diag([1, 1, 1, -1])
    values = metrics.nees(believed, broken, metrics.relative_from_absolute(flight.absolute))
    assert np.isinf(metrics.anees(values, always()))


def test_band_is_that_of_the_chi_square_table() -> None:
    band = metrics.anees_band(1, 6)  # chi-square, 20 degrees of freedom: 9.591 and 34.170
    assert band.low * 20 == pytest.approx(9.591, abs=1e-3)
    assert band.high * 20 == pytest.approx(34.170, abs=1e-3)


def test_agents_that_share_a_wrong_frame_agree_and_one_that_errs_does_not(flight: Flight) -> None:
    states = np.full((K, N, N), LOCALISED, np.uint8)
    assert metrics.disagreement_m(flight.absolute, states) < 1e-9
    turned = compose(np.array([5.0, 1.0, 0.0, 1.0]), flight.absolute)  # common to all: no relative pose changes
    assert metrics.disagreement_m(turned, states) < 1e-9
    off = flight.absolute.copy()
    off[:, 1, 3, 2] += 0.4
    assert metrics.disagreement_m(off, states) == pytest.approx(0.4)
    states[:, 1, 3] = SEARCHING  # it does not claim to know
    assert metrics.disagreement_m(off, states) < 1e-9


def test_share_of_innovations_inside_their_gate() -> None:
    counts = np.full((2, 2, 2), np.nan)
    assert np.isnan(metrics.nis_inside(counts))
    counts[0] = [[10, 9], [10, 10]]
    assert metrics.nis_inside(counts) == 0.95


def test_inverse_of_a_naive_start(flight: Flight) -> None:
    """The contract's words: the origin of I's odometry frame is I's true pose at the start, if odometry begins at 0."""
    zeroed = relative_pose(flight.odometry[0], flight.odometry)
    np.testing.assert_allclose(zeroed[0], 0, atol=1e-12)
    origins = metrics.odometry_origins(flight.truth, zeroed)
    np.testing.assert_allclose(origins[:, :3], flight.truth[0, :, :3], atol=1e-9)
    np.testing.assert_allclose(compose(origins, inverse(flight.truth[0]))[:, :3], 0, atol=1e-9)
