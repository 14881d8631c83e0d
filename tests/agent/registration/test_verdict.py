"""The commit rule: margins, and how well each MAV fits."""

import numpy as np
import pytest

from agent.registration.hypotheses import WINDOW
from agent.registration.verdict import LASTING_TICKS, LEAST_TICKS, STRONG, judge
from tests.agent.registration.beginning import recorded

P_D = 0.9


def two(evidence):
    """A hypothesis and one that places the only other MAV elsewhere; evidence (2, T)."""
    poses = np.zeros((2, 2, 4))
    poses[:, 1, 0] = 2.0, -2.0
    return recorded(poses, evidence)


@pytest.mark.parametrize("ticks", [4, 9, 16, 25, 36])
def test_the_margin_grows_with_the_root_of_the_ticks(ticks):
    """12 nats, and six standard deviations of a walk of at least 3 nats a tick; at first in proportion to them."""
    least = 12 + 6 * 3 * np.sqrt(ticks)
    if ticks < LASTING_TICKS:
        least = max(least, STRONG * 2 * ticks)
    for lead, clear in ((0.99 * least, False), (1.01 * least, True)):
        verdict = judge(two(np.array([[lead / ticks], [0.0]]) * np.ones(ticks)), P_D)
        assert verdict.leader == 0
        assert verdict.clear[1] == clear
        assert verdict.rivalled[1] == (not clear)
        assert verdict.rival[1] == 1
        assert verdict.margin[1] == pytest.approx(lead - least)


def test_a_restless_lead_must_be_larger():
    rng = np.random.default_rng(0)
    calm = np.array([[15.0], [0.0]]) * np.ones(30)
    restless = calm + rng.normal(0, 20, (2, 30))
    assert judge(two(calm), P_D).clear[1]
    assert not judge(two(restless), P_D).clear[1]


def commits(evidence, ends):
    """At how many of these ticks one of two hypotheses would be called localised."""
    made, count = two(np.zeros((2, WINDOW))), 0
    for end in ends:
        window = evidence[:, max(0, end - WINDOW) : end]
        made.evidence[:] = np.nan
        made.evidence[:, -window.shape[1] :] = window
        count += judge(made, P_D).clear[1]
    return count


@pytest.mark.statistical
def test_what_cannot_be_decided_is_never_decided():
    """Two hypotheses that are both true: their lead is a zero-mean walk of 3 nats a tick. In 300 ticks of 200 walks:
    at every tick of some, and of each when the lead is largest, on the whole and for its length."""
    ends = np.arange(LEAST_TICKS, 301)
    begins, constant = np.maximum(0, ends - WINDOW), 0
    for seed in range(200):
        evidence = np.random.default_rng([1, seed]).normal(100, 3 / np.sqrt(2), (2, 300))
        sums = np.append(0, np.cumsum(evidence[0] - evidence[1]))
        lead = np.abs(sums[ends] - sums[begins])
        largest = ends[[lead.argmax(), (lead / np.sqrt(ends - begins)).argmax()]]
        assert commits(evidence, ends if seed < 5 else largest) == 0
        constant += lead.max() > 12
    assert constant > 190  # 12 nats alone would have been passed nearly always


def test_what_can_be_decided_is_decided_in_a_few_ticks():
    evidence = np.array([[150.0], [100.0]]) + np.random.default_rng(2).normal(0, 3, (2, LEAST_TICKS))
    assert judge(two(evidence), P_D).clear[1]
    assert not judge(two(evidence[:, 1:]), P_D).clear[1]


def test_every_mav_has_its_own_rival():
    poses = np.zeros((4, 4, 4))
    poses[:, 1:, 0] = 2, 4, 6
    poses[1, 1, 1] = poses[2, 2, 1] = poses[3, 2, 1] = 1.0
    evidence = np.array([[10.0], [8.0], [-30.0], [-40.0]]) * np.ones(20)
    verdict = judge(recorded(poses, evidence), P_D)
    assert verdict.leader == 0
    assert verdict.rivalled.tolist() == [False, True, False, False]
    assert verdict.clear.tolist() == [True, False, True, True]
    assert verdict.rival[1:3].tolist() == [1, 2]
    assert verdict.margin[3] == np.inf


def test_a_rival_that_leaves_a_mav_out_is_one_too():
    poses = np.zeros((2, 3, 4))
    poses[:, 1:, 0] = 2, 4
    verdict = judge(recorded(poses, np.ones((2, 10)), [[True] * 3, [True, True, False]]), P_D)
    assert verdict.rivalled.tolist() == [False, False, True]


def test_who_is_not_placed_is_not_clear():
    poses = np.zeros((1, 3, 4))
    poses[0, 1:, 0] = 2, 4
    verdict = judge(recorded(poses, np.ones((1, 10)), [[True, True, False]]), P_D)
    assert verdict.clear.tolist() == [True, True, False]


def test_more_mavs_more_unknowns_a_tick():
    margins = []
    for mavs in (7, 28):
        poses = np.zeros((2, mavs, 4))
        poses[:, 1:, 0] = 2.0 * np.arange(1, mavs)
        poses[1, 1, 1] = 1.0
        margins.append(judge(recorded(poses, np.zeros((2, 25))), P_D).margin[1])
    assert margins == [-12 - 6 * 3 * 5, -12 - 6 * 6 * 5]


def crowd():
    poses = np.zeros((1, 5, 4))
    poses[0, 1:, 0] = 2, 4, 6, 8
    return recorded(poses, np.ones((1, 20)))


@pytest.mark.parametrize("direction", ["seen by the others", "seeing the others"])
def test_both_directions_must_fit_on_their_own(direction):
    made = crowd()
    pairs = (0, slice(None), 2) if direction == "seen by the others" else (0, 2)
    made.explained[pairs] = 0.3 * made.expected[pairs]
    verdict = judge(made, P_D)
    assert verdict.fitting.tolist() == [True, True, False, True, True]
    row = 0 if direction == "seen by the others" else 1
    assert verdict.shares[row, 2] == pytest.approx(0.3)
    # of the other direction he does what can be expected, and the others suffer little
    assert verdict.shares[1 - row, 2] == pytest.approx(0.9)
    assert verdict.shares[1 - row, 1] == pytest.approx((3 * 0.9 + 0.3) / 4)


def test_few_sightings_prove_nothing():
    made = crowd()
    made.expected *= 0.05
    made.explained *= 0.05
    assert not judge(made, P_D).fitting.any()


@pytest.mark.parametrize("P_D", [0.5, 0.7, 0.9, 0.99])
def test_who_is_seen_as_often_as_the_detector_says_fits(P_D):
    made = crowd()
    made.explained = P_D * made.expected
    assert judge(made, P_D).fitting.all()


def test_residuals_that_are_too_large_fit_nobody():
    made = crowd()
    made.square = 2 * made.square
    assert not judge(made, P_D).fitting.any()


def test_without_any_tick_in_common_nothing_is_decided():
    made = two(np.zeros((2, 0)))
    made.evidence[0, :5], made.evidence[1, -5:] = 100.0, 0.0
    assert not judge(made, P_D).clear[1]
