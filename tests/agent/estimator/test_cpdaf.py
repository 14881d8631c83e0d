"""The fast update against the plain one, and the plain one against the paper's mixture."""

import numpy as np
import pytest

from agent.estimator import cpdaf
from agent.estimator.enumeration import enumerate_all
from agent.estimator.gating import chi_square_quantile, gate
from tests.agent.estimator.oracle import mixture, random_case

EXACT = cpdaf.Rules(gate_threshold=np.inf, evaluation=True, pruned_mass=0.0)
SIZES = [(L, M) for L in range(5) for M in range(6)]


def applied(case, found):
    P_xz = case.P_xz[:, found.rows]
    return case.x + P_xz @ found.g, case.P - P_xz @ found.W @ P_xz.T


def relative_error(case, found, expected):
    x, P = applied(case, found)
    shift = max(np.abs(expected.x - case.x).max(), 1e-3)
    return max(np.abs(x - expected.x).max() / shift, np.abs(P - expected.P).max() / np.abs(case.P).max())


def count_by_formula(L, M):
    from math import comb, factorial

    return sum(comb(L, D) * comb(M, D) * factorial(D) for D in range(min(L, M) + 1))


@pytest.mark.parametrize(("L", "M"), SIZES)
@pytest.mark.parametrize("seed", range(4))
def test_nothing_pruned_equals_one_kalman_posterior_per_hypothesis(L, M, seed):
    case = random_case(np.random.default_rng([seed, L, M]), L, M)
    expected = mixture(case, np.ones((L, M), bool))
    assert expected.hypotheses == count_by_formula(L, M)
    found = cpdaf.associate(case.S, case.innovations, case.P_D, case.clutter, EXACT)
    assert relative_error(case, found, expected) < 1e-9


@pytest.mark.parametrize(("L", "M"), SIZES)
def test_the_plain_enumeration_equals_the_mixture(L, M):
    case = random_case(np.random.default_rng([9, L, M]), L, M)
    plain = cpdaf.Rules(gate_threshold=np.inf, evaluation=False, pruned_mass=0.0)
    found = cpdaf.associate(case.S, case.innovations, case.P_D, case.clutter, plain)
    assert relative_error(case, found, mixture(case, np.ones((L, M), bool))) < 1e-9


def test_it_counts_21_hypotheses_for_two_targets_and_four_detections():
    case = random_case(np.random.default_rng(0), 2, 4)
    assert enumerate_all(case.S, case.innovations, case.P_D, case.clutter, np.ones((2, 4), bool)).hypotheses == 21


@pytest.mark.parametrize("seed", range(60))
def test_within_gates_equals_the_mixture_within_the_same_gates(seed):
    rng = np.random.default_rng([1, seed])
    L, M = int(rng.integers(1, 5)), int(rng.integers(0, 6))
    case = random_case(rng, L, M)
    threshold = float(rng.choice([8.0, 14.0, 40.0]))
    rules = cpdaf.Rules(threshold, True, 0.0)
    inside = gate(case.S, case.innovations, case.P_D, threshold).inside if M else np.ones((L, 0), bool)
    found = cpdaf.associate(case.S, case.innovations, case.P_D, case.clutter, rules)
    assert relative_error(case, found, mixture(case, inside)) < 1e-9


@pytest.mark.parametrize("pruned", [1e-12, 1e-6, 1e-3])
@pytest.mark.parametrize("seed", range(60))
def test_pruned_is_off_by_no_more_than_the_lost_mass(seed, pruned):
    rng = np.random.default_rng([2, seed])
    L, M = int(rng.integers(1, 5)), int(rng.integers(1, 6))
    case = random_case(rng, L, M, spread=0.2)
    threshold = 30.0
    inside = gate(case.S, case.innovations, case.P_D, threshold).inside
    expected = mixture(case, inside)
    found = cpdaf.associate(case.S, case.innovations, case.P_D, case.clutter, cpdaf.Rules(threshold, True, pruned))
    x, P = applied(case, found)
    allowed = 2 * found.lost_mass + 1e-11
    assert np.abs(x - expected.x).max() <= allowed * expected.reach
    assert np.abs(P - expected.P).max() <= allowed * (expected.reach**2 + np.abs(case.P).max())


@pytest.mark.parametrize("seed", range(10))
def test_the_tree_with_many_candidates_equals_the_enumeration_within_the_lost_mass(seed):
    rng = np.random.default_rng([3, seed])
    case = random_case(rng, 5, 6)
    inside = np.ones((5, 6), bool)
    plain = enumerate_all(case.S, case.innovations, case.P_D, case.clutter, inside)
    for pruned in (0.0, 1e-6):
        rules = cpdaf.Rules(np.inf, True, pruned)
        found = cpdaf.associate(case.S, case.innovations, case.P_D, case.clutter, rules)
        g, W = np.zeros(15), np.zeros((15, 15))
        g[found.rows] = found.g
        W[np.ix_(found.rows, found.rows)] = found.W
        allowed = max(2 * found.lost_mass, 1e-9)
        assert np.abs(g - plain.g).max() <= allowed * np.abs(plain.g).max() * 10
        assert np.abs(W - plain.W).max() <= allowed * np.abs(plain.W).max() * 10


@pytest.mark.parametrize("seed", range(20))
def test_the_covariance_stays_positive_and_symmetric(seed):
    rng = np.random.default_rng([4, seed])
    case = random_case(rng, 4, 5)
    rules = cpdaf.Rules(chi_square_quantile(0.9999, 3), True, 1e-6)
    _, P = applied(case, cpdaf.associate(case.S, case.innovations, case.P_D, case.clutter, rules))
    assert np.abs(P - P.T).max() < 1e-12
    assert np.linalg.eigvalsh(P).min() > 0


def test_a_target_that_cannot_be_seen_takes_no_detection():
    case = random_case(np.random.default_rng(5), 3, 3, P_D=np.array([0.9, 0.0, 0.9]))
    found = cpdaf.associate(case.S, case.innovations, case.P_D, case.clutter, cpdaf.Rules(30.0, True, 0.0))
    assert not set(found.rows) & {3, 4, 5}


def test_no_detections_change_nothing():
    case = random_case(np.random.default_rng(6), 3, 0)
    assert cpdaf.associate(case.S, case.innovations, case.P_D, case.clutter, EXACT).rows.size == 0


def test_told_the_truth_it_is_the_kalman_update():
    case = random_case(np.random.default_rng(7), 3, 4)
    found = cpdaf.told(case.S, case.innovations, np.array([2, -1, 0, -1]))
    rows = [6, 7, 8, 0, 1, 2]
    mu = np.concatenate([case.innovations[2, 0], case.innovations[0, 2]])
    K = case.P_xz[:, rows] @ np.linalg.inv(case.S[np.ix_(rows, rows)])
    x, P = applied(case, found)
    np.testing.assert_allclose(x, case.x + K @ mu, rtol=1e-9)
    np.testing.assert_allclose(P, case.P - K @ case.P_xz[:, rows].T, rtol=1e-8, atol=1e-10)
