"""Is the curve the one of least snap, does it keep its ends and the limits?"""

import numpy as np
import pytest
from scipy.optimize import minimize

from agent.controller.trajectory import Limits, Sample, Trajectory, duration_within, minimum_snap


def derivatives(way: Trajectory, piece: int, share: float) -> np.ndarray:
    """(7, 3) of one piece, in s."""
    duration_s = np.diff(way.times_s)[piece]
    found = []
    for axis in range(3):
        polynomial = np.polynomial.Polynomial(way.coefficients[piece][:, axis])
        found.append([(polynomial.deriv(k) if k else polynomial)(share) / duration_s**k for k in range(7)])
    return np.array(found).T


def snap(way: Trajectory) -> float:
    """Integral of its square."""
    total = 0.0
    for coefficients, duration_s in zip(way.coefficients, np.diff(way.times_s), strict=True):
        for axis in range(3):
            square = np.polynomial.Polynomial(coefficients[:, axis]).deriv(4) ** 2
            total += (square.integ()(1) - square.integ()(0)) / duration_s**7
    return total


def drawn(seed, waypoints=5):
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0], rng.uniform(0.7, 3, waypoints - 1).cumsum()])
    begin = Sample(np.zeros(3), *rng.normal(0, 1, (3, 3)))
    return rng.uniform(-3, 3, (waypoints, 3)), times, begin


@pytest.mark.parametrize("seed", range(10))
def test_it_passes_the_waypoints_and_keeps_both_ends(seed):
    waypoints, times, begin = drawn(seed)
    way = minimum_snap(waypoints, times, begin)
    for waypoint, time_s in zip(waypoints, times, strict=True):
        np.testing.assert_allclose(way.at(time_s).position, waypoint, atol=1e-9)
    for part, given in zip(way.at(0.0)[1:], begin[1:], strict=True):
        np.testing.assert_allclose(part, given, atol=1e-9)
    np.testing.assert_allclose(derivatives(way, -1, 1.0)[1:4], 0, atol=1e-8)
    for time_s in (times[-1], times[-1] + 5):
        np.testing.assert_array_equal(np.stack(way.at(time_s)[1:]), 0)


@pytest.mark.parametrize("seed", range(10))
def test_six_derivatives_are_continuous(seed):
    way = minimum_snap(*drawn(seed))
    for k in range(3):
        before, after = derivatives(way, k, 1.0), derivatives(way, k + 1, 0.0)
        np.testing.assert_allclose(before, after, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_no_other_derivatives_at_the_waypoints_make_less_snap(seed):
    """An independent search, over the velocity, acceleration and jerk at the inner waypoint."""
    waypoints, times, begin = drawn(seed, 3)
    best = minimum_snap(waypoints, times, begin)

    def of(free):
        inner = Sample(waypoints[1], *free.reshape(3, 3))
        pieces = []
        for k, (start, end) in enumerate([(begin, inner), (inner, Sample.rest(waypoints[2]))]):
            duration_s, conditions = times[k + 1] - times[k], []
            for share, given, place in ((0.0, start, waypoints[k]), (1.0, end, waypoints[k + 1])):
                for order in range(4):
                    basis = [np.polynomial.Polynomial.basis(p).deriv(order)(share) for p in range(8)]
                    conditions.append((basis, (place if order == 0 else given[order]) * duration_s**order))
            rows, values = zip(*conditions, strict=True)
            pieces.append(np.linalg.solve(np.array(rows, float), np.array(values)))
        return snap(Trajectory(times, np.array(pieces)))

    inner = best.at(times[1])
    chosen = np.concatenate(inner[1:])
    assert of(chosen) == pytest.approx(snap(best), rel=1e-7)
    searched = minimize(of, chosen + 0.3, method="BFGS")
    assert searched.fun >= snap(best) * (1 - 1e-6)
    np.testing.assert_allclose(searched.x, chosen, atol=0.02)


@pytest.mark.parametrize("seed", range(10))
def test_from_rest_the_limits_are_kept_and_hardly_more(seed):
    rng = np.random.default_rng(seed)
    goal, limits = rng.uniform(-5, 5, 3), Limits(*rng.uniform(0.3, 2, 2))
    duration_s = duration_within(Sample.rest(np.zeros(3)), goal, limits)
    for given, most in ((duration_s, 1.001), (duration_s - 0.15, np.inf)):
        way = minimum_snap(np.stack([np.zeros(3), goal]), np.array([0.0, given]))
        samples = [way.at(t) for t in np.linspace(0, given, 400)]
        speed = max(np.linalg.norm(each.velocity) for each in samples) / limits.speed_m_s
        acceleration = max(np.linalg.norm(each.acceleration) for each in samples) / limits.acceleration_m_s2
        assert max(speed, acceleration) <= most
    assert max(speed, acceleration) > 1


@pytest.mark.parametrize("seed", range(10))
def test_a_way_that_is_changed_in_mid_flight_keeps_the_limits(seed):
    rng, limits = np.random.default_rng(seed), Limits(1.0, 1.0)
    goal = rng.uniform(-4, 4, 3)
    way = minimum_snap(
        np.stack([np.zeros(3), goal]), np.array([0.0, duration_within(Sample.rest(np.zeros(3)), goal, limits)])
    )
    now = way.at(rng.uniform(0.2, 0.6) * way.duration_s)
    moved = goal + rng.normal(0, 0.1, 3)
    duration_s = duration_within(now, moved, limits, least_s=1.0)
    anew = minimum_snap(np.stack([now.position, moved]), np.array([0.0, duration_s]), now)
    samples = [anew.at(t) for t in np.linspace(0, duration_s, 200)]
    assert max(np.linalg.norm(each.velocity) for each in samples) < 1.25
    assert max(np.linalg.norm(each.acceleration) for each in samples) < 1.25


def test_what_cannot_be_flown_is_refused():
    with pytest.raises(ValueError, match="expected two or more"):
        minimum_snap(np.zeros((1, 3)), np.zeros(1))
    with pytest.raises(ValueError, match="ascending from 0"):
        minimum_snap(np.zeros((2, 3)), np.array([0.0, 0.0]))
    with pytest.raises(ValueError, match="expected finite ones"):
        minimum_snap(np.full((2, 3), np.nan), np.array([0.0, 1.0]))
    with pytest.raises(ValueError, match="limits above 0"):
        duration_within(Sample.rest(np.zeros(3)), np.ones(3), Limits(0.0, 1.0))
