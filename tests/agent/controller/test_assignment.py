"""Is the assignment the best one, do straight ways keep apart, and do two who want one place come to terms?"""

from itertools import permutations

import numpy as np
import pytest

from agent.controller.assignment import assigned, claimed, kept

RADIUS_M = 0.325
NONE = np.zeros(7, bool)  # blocked


def apart(rng, n, least):
    while True:
        places = rng.uniform(-3, 3, (n, 3)) * [1, 1, 0.3]
        if (np.linalg.norm(places[:, None] - places, axis=-1) + np.eye(n) * 9).min() >= least:
            return places


@pytest.mark.parametrize("seed", range(20))
def test_no_other_assignment_has_a_smaller_sum_of_squares(seed):
    rng = np.random.default_rng(seed)
    positions, places = rng.uniform(-3, 3, (4, 3)), rng.uniform(-3, 3, (5, 3))
    squared = ((positions[:, None] - places) ** 2).sum(-1)
    least = min(squared[range(4), order].sum() for order in permutations(range(5), 4))
    assert squared[range(4), assigned(positions, places, NONE[: len(places)])].sum() == pytest.approx(least, abs=1e-2)


@pytest.mark.parametrize("seed", range(20))
def test_straight_ways_of_equal_duration_keep_their_distance(seed):
    rng = np.random.default_rng(seed)
    start, goal = (apart(rng, 7, 2 * np.sqrt(2) * RADIUS_M) for _ in range(2))
    goal = goal[assigned(start, goal, NONE[:7])]
    for share in np.linspace(0, 1, 101):
        now = start + share * (goal - start)
        assert (np.linalg.norm(now[:, None] - now, axis=-1) + np.eye(7) * 9).min() > 2 * RADIUS_M - 0.01


def test_equals_go_by_number_whatever_the_noise():
    positions = np.array([[0.0, 1, 0], [0, -1, 0]])
    places = np.array([[1.0, 0, 0], [-1, 0, 0]])
    for noise in np.random.default_rng(0).normal(0, 1e-5, (10, 2, 3)):
        assert assigned(positions + noise, places, NONE[:2]).tolist() == [0, 1]


def test_a_place_that_a_lower_number_claims_is_left_to_it():
    distances = np.array([1.0, 3.0, 2.0, 4.0])
    assert claimed(0, distances, {1: 2}, mav=3) == 0
    assert claimed(0, distances, {5: 0}, mav=3) == 0
    assert claimed(0, distances, {1: 0}, mav=3) == 2
    assert claimed(0, distances, {1: 0, 2: 2, 5: 1}, mav=3) == 1


def test_two_estimates_come_to_terms():
    """Each assigns by its own noisy estimate and goes by the claims of the round before."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        positions, places, claims = rng.uniform(-2, 2, (5, 3)), rng.uniform(-2, 2, (5, 3)), {}
        estimates = positions + rng.normal(0, 0.5, (5, 5, 3))
        for _ in range(5):
            claims = {
                mav: claimed(
                    int(assigned(estimates[mav - 1], places, NONE[:5])[mav - 1]),
                    np.linalg.norm(places - positions[mav - 1], axis=1),
                    {other: place for other, place in claims.items() if other != mav},
                    mav,
                )
                for mav in range(1, 6)
            }
        assert sorted(claims.values()) == [0, 1, 2, 3, 4]


def test_a_claim_is_kept_unless_another_is_much_better():
    positions, places = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.5, 0, 0], [0.52, 0, 0], [3, 0, 0]])
    assert [kept(positions, places, NONE[:3], 0, place) for place in range(3)] == [True, True, False]


def test_a_blocked_place_is_taken_only_if_there_are_too_few_others():
    positions, places = np.array([[0.0, 0, 0], [4, 0, 0]]), np.array([[0.0, 0, 0], [1.5, 0, 0], [4, 0, 0]])
    assert assigned(positions, places, np.array([True, False, False])).tolist() == [1, 2]
    assert assigned(positions, places, np.array([True, False, True])).tolist() in ([0, 1], [1, 2])
    assert not kept(positions, places, np.array([True, False, False]), 0, 0)
