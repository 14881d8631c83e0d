"""Are trajectories those of least snap, and do durations keep the limits?"""

import math

import minsnap_trajectories
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BPoly, make_interp_spline

from agent.controller.trajectory import (
    PEAK_ACCELERATION,
    PEAK_SPEED,
    Limits,
    Sample,
    duration_within,
    minimum_snap,
)
from world import clearance

LIMITS = Limits(2.0, 3.0)
GOAL = np.array([4.0, -1.0, 2.0])
seeds = st.integers(0, 2**32 - 1)


def at_rest(position=(0.0, 0.0, 0.0)):
    return Sample(np.array(position), *np.zeros((3, 3)))


def drawn(seed, waypoints=None, ratio=3.0):
    """Waypoints, times with segments that differ by up to this ratio, and a moving begin."""
    rng = np.random.default_rng(seed)
    waypoints = waypoints or rng.integers(2, 9)
    places = rng.uniform(-10, 10, (waypoints, 3))
    times_s = np.concatenate([[0.0], np.cumsum(ratio ** rng.uniform(-0.5, 0.5, waypoints - 1))])
    return places, times_s, Sample(places[0], *rng.normal(size=(3, 3)))


def sampled(trajectory, times_s):
    """(4, T, 3) position to jerk."""
    return np.array([trajectory.at(t) for t in times_s]).swapaxes(0, 1)


def at_ends(trajectory):
    """(8, S, 3) and (8, S, 3) all derivatives by time where segments begin and where they end."""
    lengths = np.diff(trajectory.times_s)[:, None]
    begins = [math.factorial(m) * trajectory.coefficients[:, m] / lengths**m for m in range(8)]
    falling = np.array([[math.perm(n, m) for n in range(8)] for m in range(8)])
    ends = [np.tensordot(falling[m], trajectory.coefficients, axes=(0, 1)) / lengths**m for m in range(8)]
    return np.array(begins), np.array(ends)


def squared_snap(polynomial):
    """The integral, by a quadrature that is exact for degree 7."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    snap, total = polynomial.derivative(4), 0.0
    for begin, end in zip(polynomial.x, polynomial.x[1:], strict=False):
        half = (end - begin) / 2
        total += half * (weights[:, None] * snap(begin + half * (1 + nodes)) ** 2).sum()
    return total


def peaks(trajectory):
    """Largest speed and acceleration of a single segment, by fine sampling."""
    of_share, shares = np.polynomial.Polynomial, np.linspace(0, 1, 2001)
    axes = [of_share(axis) for axis in trajectory.coefficients[0].T]
    rates = [[axis.deriv(m)(shares) / trajectory.duration_s**m for axis in axes] for m in (1, 2)]
    return np.linalg.norm(rates, axis=1).max(axis=1)


def to(goal, duration_s, begin):
    return minimum_snap(np.array([begin.position, goal]), np.array([0.0, duration_s]), begin)


def under_way(rng, limits):
    """A goal, how long a flight to it from rest takes, a time on the way and what is flown then."""
    goal = rng.normal(size=3) * 10 ** rng.uniform(-1, 1)
    duration_s = duration_within(at_rest(), goal, limits, rng.uniform(0, 5))
    time_s = rng.uniform(0, duration_s)
    return goal, duration_s, time_s, to(goal, duration_s, at_rest()).at(time_s)


def test_the_coefficients_are_those_of_a_published_solver():
    places, times_s, begin = drawn(1, waypoints=5)
    ends = {"velocity": np.zeros(3), "acceleration": np.zeros(3), "jerk": np.zeros(3)}
    extra = [{k: getattr(begin, k) for k in ends}, {}, {}, {}, ends]
    references = [
        minsnap_trajectories.Waypoint(t, place, **also) for t, place, also in zip(times_s, places, extra, strict=True)
    ]
    published = minsnap_trajectories.generate_trajectory(references, degree=7, num_continuous_orders=4)
    ours = minimum_snap(places, times_s, begin)
    by_time = ours.coefficients / np.diff(times_s)[:, None, None] ** np.arange(8)[:, None]
    np.testing.assert_allclose(by_time, published.coefficients, rtol=0, atol=1e-9 * np.abs(by_time).max())


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_it_is_the_clamped_spline_of_degree_seven(seed):
    """Least snap makes it so (de Boor): another way to the same trajectory, with no cost in it."""
    places, times_s, begin = drawn(seed)
    clamps = [(m, begin[m]) for m in (1, 2, 3)], [(m, np.zeros(3)) for m in (1, 2, 3)]
    spline = make_interp_spline(times_s, places, 7, bc_type=clamps)
    between = np.linspace(0, times_s[-1], 50, endpoint=False)
    for order, ours in enumerate(sampled(minimum_snap(places, times_s, begin), between)):
        theirs = spline(between, order)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("ratio", [1.0, 10.0, 1000.0])
@pytest.mark.parametrize("seed", range(3))
def test_it_goes_through_the_waypoints_from_the_begin_to_rest_and_is_continuous(seed, ratio):
    places, times_s, begin = drawn(seed, 6, ratio)
    begins, ends = at_ends(minimum_snap(places, times_s, begin))
    np.testing.assert_allclose(begins[0], places[:-1], atol=1e-9)
    np.testing.assert_allclose(ends[0], places[1:], atol=1e-9)
    np.testing.assert_allclose(begins[:4, 0], begin, atol=1e-9)
    np.testing.assert_allclose(ends[1:4, -1] / np.abs(begins[1:4]).max(axis=(1, 2))[:, None], 0, atol=1e-9)
    for before, after in zip(ends[:7, :-1], begins[:7, 1:], strict=True):
        np.testing.assert_allclose(before, after, rtol=0, atol=1e-8 * np.abs(after).max())


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_no_other_trajectory_through_the_waypoints_has_less_snap(seed):
    rng = np.random.default_rng(seed)
    places, times_s, begin = drawn(seed, waypoints=5)
    begins, ends = at_ends(minimum_snap(places, times_s, begin))
    nodes = np.concatenate([begins[:4], ends[:4, -1:]], axis=1).swapaxes(0, 1)  # (W, 4, 3)
    least = squared_snap(BPoly.from_derivatives(times_s, nodes))
    for size in (1e-3, 1e-1, 1.0):
        other = nodes.copy()
        other[1:-1, 1:] += size * rng.normal(size=(3, 3, 3))
        assert squared_snap(BPoly.from_derivatives(times_s, other)) > least


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_a_plan_made_on_the_way_goes_on_as_the_last_one_would(seed):
    places, times_s, begin = drawn(seed, waypoints=5)
    plan = minimum_snap(places, times_s, begin)
    now_s = np.random.default_rng(seed).uniform(0.1, 0.9) * times_s[1]
    now = plan.at(now_s)
    again = minimum_snap(np.vstack([now.position, places[1:]]), np.append(0.0, times_s[1:] - now_s), now)
    later_s = np.linspace(now_s, times_s[-1], 20)
    for theirs, ours in zip(sampled(plan, later_s), sampled(again, later_s - now_s), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8 * np.abs(theirs).max())


def test_before_it_begins_it_is_at_the_begin_and_after_the_end_at_rest():
    places, times_s, begin = drawn(2, waypoints=3)
    plan = minimum_snap(places, times_s, begin)
    np.testing.assert_allclose(plan.at(-1.0), begin, atol=1e-12)
    assert plan.duration_s == times_s[-1]
    for time_s in (plan.duration_s, plan.duration_s + 1):
        np.testing.assert_allclose(plan.at(time_s), at_rest(places[-1]), atol=1e-11)


def test_the_world_checks_moves_by_the_same_peaks():
    assert (PEAK_SPEED, PEAK_ACCELERATION) == (clearance.PEAK_SPEED, clearance.PEAK_ACCELERATION)
    reached = peaks(to(np.array([0.0, 3.0, 4.0]), 2.0, at_rest()))
    np.testing.assert_allclose(reached, [PEAK_SPEED * 5 / 2, PEAK_ACCELERATION * 5 / 4], rtol=1e-5)


@pytest.mark.parametrize("distance", [0.01, 0.5, 5.0, 50.0])
@pytest.mark.parametrize("limits", [Limits(0.5, 5.0), LIMITS, Limits(5.0, 0.5)])
def test_from_rest_a_duration_keeps_the_limits_and_one_step_less_would_not(distance, limits):
    goal = distance * np.array([0.6, 0.0, -0.8])
    duration_s = duration_within(at_rest(), goal, limits)
    assert round(duration_s * 10) == pytest.approx(duration_s * 10, abs=1e-9)
    assert (peaks(to(goal, duration_s, at_rest())) <= np.array(limits) * (1 + 1e-6)).all()
    if duration_s > 0.1:
        assert (peaks(to(goal, duration_s - 0.1, at_rest())) > np.array(limits)).any()


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_from_a_moving_begin_a_duration_keeps_the_limits_and_one_step_less_would_not(seed):
    rng = np.random.default_rng(seed)
    _, _, _, begin = under_way(rng, LIMITS)
    goal, least_s = begin.position + rng.normal(size=3), rng.choice([0.0, 2.0])
    duration_s = duration_within(begin, goal, LIMITS, least_s)
    if math.isfinite(duration_s):
        assert duration_s >= least_s
        assert (peaks(to(goal, duration_s, begin)) <= np.array(LIMITS) * 1.001).all()
        if duration_s - 0.1 > max(least_s, 0.1):
            assert (peaks(to(goal, duration_s - 0.1, begin)) > np.array(LIMITS)).any()
    else:
        for longer_s in np.arange(max(least_s, 0.1), 30, 0.5):
            assert (peaks(to(goal, longer_s, begin)) > np.array(LIMITS)).any()


def test_on_the_way_the_rest_of_the_plan_is_within_the_limits():
    """What is left is rounded up to a step; the trajectory of that duration is another one: it may need some more."""
    more_s = []
    for seed in range(300):
        goal, whole_s, time_s, begin = under_way(np.random.default_rng(seed), LIMITS)
        more_s.append(duration_within(begin, goal, LIMITS, whole_s - time_s) - (whole_s - time_s))
    assert np.mean(np.array(more_s) <= 0.1 + 1e-9) >= 0.99
    assert max(more_s) <= 0.5


def test_a_begin_beyond_the_limits_may_slow_down():
    begin = Sample(np.zeros(3), np.array([3.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))
    duration_s = duration_within(begin, np.array([8.0, 0.0, 0.0]), LIMITS)
    assert (peaks(to(np.array([8.0, 0.0, 0.0]), duration_s, begin)) <= np.array([3.0, 3.0]) * 1.001).all()


@pytest.mark.parametrize("way", [-10.0, -1.0, 0.0, 0.01, 1.0, 10.0])
@pytest.mark.parametrize("limits", [Limits(2.0, 0.1), Limits(1.0, 1.0), Limits(2.0, 5.0)])
def test_a_begin_that_only_moves_always_has_a_duration(limits, way):
    begin = Sample(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))
    goal = np.array([way, 0.0, 0.0])
    duration_s = duration_within(begin, goal, limits)
    assert (peaks(to(goal, duration_s, begin)) <= np.array(limits) * 1.001).all()


def test_there_may_be_no_duration_from_a_moving_begin():
    begin = Sample(np.zeros(3), np.array([2.0, 0.0, 0.0]), np.array([3.0, 0.0, 0.0]), np.zeros(3))
    assert duration_within(begin, GOAL, LIMITS) == math.inf


def test_durations_are_rounded_up_and_never_nothing():
    assert duration_within(at_rest(GOAL), GOAL, LIMITS) == 0.1
    assert duration_within(at_rest(GOAL), GOAL, LIMITS, 0.3) == 0.3
    assert duration_within(at_rest(GOAL), GOAL, LIMITS, 0.1 + 0.2) == 0.3  # a rounding error is not a step
    assert duration_within(at_rest(GOAL), GOAL, LIMITS, 7.01) == 7.1


@pytest.mark.parametrize(
    ("waypoints", "times_s", "begin", "message"),
    [
        ([GOAL], [0.0], None, r"waypoints = \[\[4.0, -1.0, 2.0\]\]: expected two or more"),
        ([[0.0, 0.0], [1.0, 1.0]], [0.0, 1.0], None, "waypoints = .*three finite numbers, m"),
        ([GOAL, [0.0, np.nan, 0.0]], [0.0, 1.0], None, "waypoints = .*nan"),
        ([GOAL, GOAL], [0.0, 1.0, 2.0], None, r"times_s = .*expected 2 finite numbers rising from 0, s"),
        ([GOAL, GOAL], [], None, r"times_s = \[\]: expected 2"),
        ([GOAL, GOAL], [1.0, 2.0], None, "times_s = "),
        ([GOAL, GOAL], [0.0, 0.0], None, "times_s = "),
        ([GOAL, GOAL], [0.0, np.nan], None, "times_s = .*nan"),
        ([GOAL, GOAL], [0.0, np.inf], None, "times_s = .*inf"),
        ([GOAL, GOAL], [0.0, 1.0], at_rest(), "begin.position = .*expected the first waypoint"),
        ([GOAL, GOAL], [0.0, 1.0], at_rest(GOAL)._replace(jerk=np.full(3, np.inf)), r"begin.jerk = .*m/s\^3"),
    ],
)
def test_what_is_no_trajectory_is_refused(waypoints, times_s, begin, message):
    with pytest.raises(ValueError, match=message):
        minimum_snap(np.array(waypoints), np.array(times_s), begin)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"begin": at_rest()._replace(velocity=np.array([0.0, np.nan, 0.0]))}, r"begin.velocity = .*nan.*, m/s$"),
        ({"begin": at_rest()._replace(position=np.zeros(2))}, "begin.position = .*three finite numbers, m$"),
        ({"goal": np.array([np.inf, 0.0, 0.0])}, "goal = .*inf.*three finite numbers, m$"),
        ({"limits": Limits(0.0, 1.0)}, "limits.speed_m_s = 0.0: expected a positive finite number, m/s$"),
        ({"limits": Limits(1.0, np.inf)}, r"limits.acceleration_m_s2 = inf: .*m/s\^2$"),
        ({"limits": Limits(np.nan, 1.0)}, "limits.speed_m_s = nan"),
        ({"least_s": -1.0}, "least_s = -1.0: expected a finite number of at least 0, s"),
        ({"least_s": np.nan}, "least_s = nan"),
    ],
)
def test_what_has_no_duration_is_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        duration_within(**({"begin": at_rest(), "goal": GOAL, "limits": LIMITS} | changed))
