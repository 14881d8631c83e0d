"""Does a way keep off what hangs in it, and is it straight where nothing does?"""

import numpy as np
import pytest

from agent.controller.detour import waypoints
from agent.controller.trajectory import Limits, Sample, duration_within, through

LIMITS = Limits(1.0, 1.0)


def way(begin, goal, obstacles):
    points = waypoints(begin, goal, np.reshape(obstacles, (-1, 3)))
    begin = Sample.rest(begin)
    planned = through(points, duration_within(begin, goal, LIMITS), begin, LIMITS)
    return planned, np.array([planned.at(t) for t in np.linspace(0, planned.duration_s, 200)])


@pytest.mark.parametrize("seed", range(20))
def test_it_keeps_off_what_hangs_there_and_keeps_the_limits(seed):
    rng = np.random.default_rng(seed)
    begin, goal = rng.uniform(-1, 1, 3), rng.uniform([3, -1, -1], [5, 1, 1])
    obstacle = begin + rng.uniform(0.3, 0.7) * (goal - begin) + rng.normal(0, 0.3, 3)
    planned, flown = way(begin, goal, obstacle)
    assert np.linalg.norm(flown[:, 0] - obstacle, axis=1).min() > 0.65
    assert np.linalg.norm(flown[:, 1], axis=1).max() <= LIMITS.speed_m_s * 1.001
    assert np.linalg.norm(flown[:, 2], axis=1).max() <= LIMITS.acceleration_m_s2 * 1.01
    np.testing.assert_allclose(planned.at(planned.duration_s).position, goal, atol=1e-9)


def test_straight_above_is_passed_too():
    _, flown = way(np.zeros(3), np.array([0.0, 0, 4]), [0.0, 0, 2])
    assert np.linalg.norm(flown[:, 0] - [0, 0, 2], axis=1).min() > 0.65


def test_what_is_not_in_the_way_changes_nothing():
    begin, goal = np.zeros(3), np.array([4.0, 0, 0])
    for obstacles in ([], [2.0, 1.5, 0], [-1.0, 0, 0], [5.0, 0, 0]):
        np.testing.assert_array_equal(waypoints(begin, goal, np.reshape(obstacles, (-1, 3))), [begin, goal])


def test_who_stays_where_it_is_stays():
    at = np.array([1.0, 2, 3])
    np.testing.assert_array_equal(waypoints(at, at, np.array([[1.5, 2, 3]])), [at, at])
