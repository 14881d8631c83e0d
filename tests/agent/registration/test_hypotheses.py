"""The record of several hypotheses: which are the same, which are worth keeping, how far one leads."""

import numpy as np
import pytest

from agent.registration.bank import Explained
from agent.registration.hypotheses import WINDOW, Hypotheses
from tests.agent.registration.beginning import bank_at, box, recorded


def places(rng, K, mavs):
    """(K, N, 4) hypotheses that place everybody but the station differently."""
    poses = np.stack([np.column_stack([box(rng, mavs), rng.uniform(-3, 3, mavs)]) for _ in range(K)])
    poses[:, 0] = 0.0
    return poses


def tick(K, N, evidence):
    ones = np.ones((K, N, N))
    return Explained(np.full(K, evidence), ones, 0.5 * ones, np.full(K, 6.0), np.full(K, 2.0))


def test_duplicates_are_merged_and_the_longest_record_stays():
    rng = np.random.default_rng(0)
    poses = places(rng, 3, 4)
    poses[1] = poses[0] + [0.05, 0, 0, 0.02]  # relative to the station, the same
    made = recorded(poses, np.zeros((3, 10)))
    made.evidence[0, -10:-4] = np.nan
    assert made.merged().names.tolist() == [1, 2]


def test_of_two_records_of_one_length_the_better_stays():
    poses = places(np.random.default_rng(1), 1, 4)[[0, 0]]
    assert recorded(poses, [[1.0] * 5, [2.0] * 5]).merged().names.tolist() == [1]


@pytest.mark.parametrize("change", [[0.4, 0, 0, 0], [0, 0, -0.4, 0], [0, 0, 0, 0.2]])
def test_whoever_places_one_mav_elsewhere_is_no_duplicate(change):
    poses = places(np.random.default_rng(2), 1, 4)[[0, 0]]
    poses[1, 2] += change
    made = recorded(poses, np.zeros((2, 5)))
    assert made.merged() is made
    assert made.elsewhere()[0, 1].tolist() == [False, False, True, False]


def test_a_station_that_stands_otherwise_does_not_matter():
    """What is compared is how they stand to one another."""
    poses = places(np.random.default_rng(3), 1, 4)[[0, 0]]
    turned = poses[0] @ np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    poses[1] = turned + np.array([3, 2, 1, np.pi / 2])
    assert not recorded(poses, np.zeros((2, 5))).elsewhere().any()


def test_who_is_placed_by_one_only_is_elsewhere_and_who_by_none_is_not():
    poses = places(np.random.default_rng(4), 1, 4)[[0, 0]]
    placed = np.array([[True, True, False, False], [True, True, True, False]])
    assert recorded(poses, np.zeros((2, 5)), placed).elsewhere()[0, 1].tolist() == [False, False, True, False]


def test_a_turn_is_a_turn_across_the_wrap_too():
    poses = np.zeros((2, 2, 4))
    poses[:, 1] = [2, 0, 0, np.pi - 0.01], [2, 0, 0, -np.pi + 0.01]
    assert not recorded(poses, np.zeros((2, 5))).elsewhere().any()


def test_who_places_one_of_the_team_elsewhere_is_against_it():
    poses = np.tile(places(np.random.default_rng(12), 1, 4), (4, 1, 1))
    poses[1, 1, 0] += 1
    poses[2, 2, 0] += 1
    made = recorded(poses, np.zeros((4, 5)), [[True] * 4] * 3 + [[True, False, True, True]])
    team = np.array([True, True, False, False])
    assert made.against(poses[0], team).tolist() == [False, True, False, True]
    moved = poses[0] + [1, 2, 3, 0]  # all together: relative to the station nothing has changed
    assert made.against(moved, team).tolist() == [False, True, False, True]


@pytest.mark.parametrize("seed", range(10))
def test_the_best_rival_of_every_mav_is_kept_however_bad(seed):
    """Most hypotheses agree with the leader on all but one MAV; those that question the others score worst."""
    rng = np.random.default_rng([5, seed])
    mavs, common = 5, places(rng, 1, 5)[0]
    poses = np.tile(common, (12, 1, 1))
    poses[1:, 4, 0] += np.arange(1, 12)
    score = -np.arange(12.0)
    for k, j in ((9, 1), (10, 2), (11, 3)):
        poses[k, 4], poses[k, j, 1] = common[4], common[j, 1] + 2
    shuffled = rng.permutation(12)
    made = recorded(poses[shuffled], score[shuffled, None] * np.ones(5))
    missing = np.arange(mavs) > 0
    kept = {int(shuffled[k]) for k in made.worth(8, missing)}
    assert kept == {0, 1, 2, 3, 4, 9, 10, 11}
    assert {int(shuffled[k]) for k in made.worth(5, missing)} == {0, 1, 9, 10, 11}
    known = np.array([False, True, False, True, True])  # nobody asks for a rival of 2
    assert {int(shuffled[k]) for k in made.worth(5, known)} == {0, 1, 2, 9, 11}


def test_fewer_than_may_be_kept_are_all_kept():
    made = recorded(places(np.random.default_rng(6), 3, 4), np.zeros((3, 5)))
    assert made.worth(8, np.ones(4, bool)) == [0, 1, 2]


def test_scores_are_compared_over_common_ticks():
    evidence = np.array([[100.0, 100, 1, 1], [0, 0, 3, 3]])
    made = recorded(places(np.random.default_rng(7), 2, 3), evidence)
    made.evidence[1, -4:-2] = np.nan
    assert made.ticks == 2
    assert made.recent().tolist() == [2, 6]


def test_the_lead_counts_the_ticks_that_two_have_in_common():
    rng = np.random.default_rng(8)
    evidence = rng.normal(50, 10, (3, 20))
    made = recorded(places(rng, 3, 3), evidence)
    made.evidence[2, -20:-5] = np.nan
    lead = made.lead(1)
    assert lead.ticks.tolist() == [20, 20, 5]
    expected = [(evidence[1] - evidence[0]).sum(), 0, (evidence[1] - evidence[2])[-5:].sum()]
    np.testing.assert_allclose(lead.nats, expected)


@pytest.mark.statistical
@pytest.mark.parametrize("trend", [0.0, 5.0, -20.0])
def test_the_walk_is_that_of_the_noise_whatever_the_trend(trend):
    """Of a lead that grows ever faster: by `trend` more every tick."""
    rng = np.random.default_rng(9)
    walks = []
    for _ in range(100):
        evidence = rng.normal(100, 3, (2, WINDOW)) / np.sqrt(2) + [[40.0], [0.0]]
        walks.append(recorded(np.zeros((2, 1, 4)), evidence).lead(0).walk[1])
        with_trend = evidence - [[0.0], [1.0]] * np.arange(WINDOW) * abs(trend) / WINDOW
        walks.append(recorded(np.zeros((2, 1, 4)), with_trend).lead(0).walk[1])
    assert np.mean(walks) == pytest.approx(3 * np.sqrt(WINDOW), rel=0.05)


@pytest.mark.statistical
def test_ticks_that_tell_nothing_are_not_taken_for_noise():
    """Every third tick is worth 50 nats, give or take three; in the others nothing was heard."""
    rng = np.random.default_rng(10)
    D = np.where(np.arange(WINDOW) % 3 == 0, rng.normal(50, 3, WINDOW), rng.normal(0, 0.5, WINDOW))
    telling = (WINDOW + 2) // 3
    walk = recorded(np.zeros((2, 1, 4)), np.stack([D, np.zeros(WINDOW)])).lead(0).walk[1]
    assert 0.5 * 3 * np.sqrt(telling) < walk < 2 * 3 * np.sqrt(telling)


def test_how_far_the_last_ticks_spread_them():
    made = recorded(places(np.random.default_rng(10), 3, 4), [[0.0, 50, 1, 2], [0.0, 0, 5, 6], [0.0, 0, 3, 3]])
    assert made.spread(2) == 8.0
    made.evidence[1, -2] = np.nan  # it has begun in between
    assert made.spread(2) == 3.0
    made.evidence[:, -1] = np.nan
    assert made.spread(2) == 0.0


def test_what_was_earned_in_which_ticks():
    evidence = np.arange(1.0, 11)[None]
    made = recorded(np.zeros((1, 2, 4)), evidence)
    assert made.earned(0, 3, 0) == 8 + 9 + 10
    assert made.earned(0, 3, 2) == 6 + 7 + 8
    assert made.earned(0, 8, 2) == sum(range(1, 9))
    assert made.earned(0, 0, 4) == 0
    assert made.earned(0, 9, 2) == -np.inf
    assert made.earned(0, 1, 10) == -np.inf


def test_nothing_is_said_of_ticks_that_the_record_has_let_go():
    made = recorded(np.zeros((1, 2, 4)), np.ones((1, WINDOW)))
    assert made.earned(0, 5, WINDOW - 2) == -np.inf


def test_who_is_hopelessly_behind_is_dropped():
    poses = places(np.random.default_rng(10), 3, 3)
    made = recorded(poses, np.array([[0.0], [-1.0], [-100.0]]) * np.ones(10))
    assert made.without_hopeless().names.tolist() == [0, 1]
    assert made.without_hopeless(best=50.0).names.tolist() == [0, 1]
    assert not len(made.without_hopeless(best=1e4))


def test_in_its_first_tick_a_hypothesis_earns_nothing_and_then_it_fades():
    made = Hypotheses.fresh(bank_at(np.zeros((2, 3, 4))), [4, 7])
    made.note(tick(2, 3, 5.0), burn_in=True)
    assert made.ticks == 0
    for _ in range(3):
        made.note(tick(2, 3, 5.0))
    assert made.ticks == 3
    assert made.recent().tolist() == [15, 15]
    assert made.expected[0, 0, 1] == pytest.approx(1 + 0.95 + 0.95**2 + 0.95**3)
    assert made.explained[0, 0, 1] == pytest.approx(made.expected[0, 0, 1] / 2)
    assert made.square[0] == pytest.approx(3 * made.events[0])


def test_the_record_ends_where_the_window_does():
    made = Hypotheses.fresh(bank_at(np.zeros((1, 2, 4))), [0])
    for k in range(WINDOW + 5):
        made.bank.y[:] = k
        made.note(tick(1, 2, float(k)))
    assert made.ticks == WINDOW
    assert made.evidence[0, [0, -1]].tolist() == [5, WINDOW + 4]
    assert made.track[0, [0, -1], 1, 2].tolist() == [5, WINDOW + 4]


def test_names_go_with_their_hypotheses():
    rng = np.random.default_rng(11)
    one, other = recorded(places(rng, 2, 3), np.zeros((2, 5))), recorded(places(rng, 2, 3), np.ones((2, 3)))
    other.names[:] = [5, 6]
    both = one.joined(other)
    assert sorted(both.names.tolist()) == [0, 1, 5, 6]
    picked = both.of([both.names.tolist().index(6), both.names.tolist().index(1)])
    assert picked.names.tolist() == [6, 1]
    np.testing.assert_array_equal(picked.bank.y[0], other.bank.y[1])
    np.testing.assert_array_equal(picked.evidence[1], one.evidence[1])
