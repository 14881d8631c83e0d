"""Why a MAV is not localised, in every sentence that there is."""

import numpy as np
import pytest

from agent.interface import messages as m
from agent.registration.reasons import situation
from agent.registration.verdict import judge
from tests.agent.registration.beginning import recorded

IDS = [3, 1, 2, 4]
TEAM = np.array([True, False, False, False])
HEARD, NOBODY = np.zeros(4), np.zeros(4, bool)
POSES = np.array([[0.0, 0, 0, 0], [2, 0, 0, 1], [4, 0, 0, 2], [6, 0, 0, 3]])


def told(made=None, saturated=None, team=TEAM, silent=HEARD, mute=NOBODY, ticks=20):
    verdict = None if made is None else judge(made, 0.9)
    return situation(made, verdict, saturated, team, silent, mute, ticks, IDS)


def with_rival(change, lead=0.0, placed=None):
    """Two hypotheses; the second is changed as given and is so many nats a tick behind."""
    poses = np.stack([POSES, POSES])
    change(poses[1])
    return recorded(poses, np.array([[lead], [0.0]]) * np.ones(20), placed)


def exchange(poses):
    poses[[1, 2]] = poses[[2, 1]]


def displace(poses):
    poses[1, 1] += 2


def test_who_is_localised_needs_no_reason():
    found = told(team=np.ones(4, bool))
    assert found.reasons == ("",) * 4
    assert found.states.tolist() == [m.LOCALISED] * 4


def test_nothing_heard():
    found = told(silent=np.array([0, 7, 4, 0]))
    assert found.reasons[1] == "nothing heard of it for 7 ticks"
    assert found.reasons[2] == "looking for a place that its sightings and those of it agree on"


def test_too_few_ticks():
    assert told(ticks=3).reasons[1] == "3 of 4 ticks heard that the search begins with"


def test_nothing_proposed_yet():
    found = told()
    assert found.reasons[1] == "looking for a place that its sightings and those of it agree on"
    assert found.states.tolist() == [m.LOCALISED, m.SEARCHING, m.SEARCHING, m.SEARCHING]
    assert found.weights.shape == (0,)
    assert found.placed.shape == (0, 4)
    assert found.poses.shape == (0, 4, 4)


def test_not_placed_by_the_leader():
    made = recorded(POSES[None], np.ones((1, 20)), [[True, True, False, True]])
    found = told(made)
    assert found.reasons[2] == "no place found that its sightings and those of it agree on"
    assert found.states[2] == m.SEARCHING


@pytest.mark.parametrize("made", [None, recorded(POSES[None], np.ones((1, 20)), [[True, True, False, True]])])
def test_no_detection_sets(made):
    found = told(made, mute=np.array([False, False, True, False]))
    assert found.reasons[2] == "none of its detection sets came in 20 ticks: it is found by what it sees, too"
    assert found.states[2] == m.SEARCHING
    assert "sets" not in found.reasons[1]


def test_one_place_or_none():
    found = told(with_rival(lambda poses: None, 1.0, [[True] * 4, [True, True, True, False]]))
    assert found.reasons[3] == "one place fits, or none, after 20 ticks"
    assert found.states[3] == m.AMBIGUOUS


def test_two_that_may_be_exchanged_are_named():
    found = told(with_rival(exchange))
    words = "two placements fit equally well after 20 ticks, it and MAV {} may be exchanged; "
    words += "a change of height by either would tell"
    assert found.reasons[1:3] == (words.format(2), words.format(1))
    assert found.reasons[3].startswith("its place is sure, but others may be exchanged")
    assert found.states.tolist() == [m.LOCALISED, m.AMBIGUOUS, m.AMBIGUOUS, m.AMBIGUOUS]


def test_one_that_may_be_elsewhere():
    found = told(with_rival(displace))
    expected = "two placements fit equally well after 20 ticks; a motion of its own would tell them apart"
    assert found.reasons[1] == expected
    assert found.states[1] == m.AMBIGUOUS


def test_one_that_may_have_another_yaw_is_not_exchanged_with_anybody():
    """Two MAVs are near one another; the first may be turned."""
    poses = np.stack([POSES, POSES])
    poses[:, 2, :3] = poses[:, 1, :3] + [0.25, 0, 0]
    poses[1, 1, 3] += 0.5
    found = told(recorded(poses, np.zeros((2, 20))))
    assert "exchanged" not in found.reasons[1]


def test_a_place_that_does_not_fit():
    made = with_rival(displace, 100.0)
    made.explained[0, :, 1] = 0.2 * made.expected[0, :, 1]
    found = told(made)
    assert found.reasons[1] == "a place is being tried: it is seen there 20 %, and sees the others 90 % of the time"
    assert found.states[1] == m.SEARCHING


def test_more_exchanges_than_can_be_tested():
    made = recorded(POSES[None], np.ones((1, 20)))
    found = told(made, saturated=np.array([False, True, False, False]))
    assert found.reasons[1].startswith("more exchanges of identity fit equally well than can be tested")
    assert found.states.tolist() == [m.LOCALISED, m.AMBIGUOUS, m.SEARCHING, m.SEARCHING]


def test_nothing_against_it_but_not_tested_yet():
    found = told(recorded(POSES[None], np.ones((1, 20))))
    assert found.reasons[1] == "one placement leads after 20 ticks, it is being tested against exchanges of identity"
    assert found.states[1] == m.SEARCHING


@pytest.mark.parametrize("seed", range(5))
def test_the_weights_are_shares_best_first(seed):
    rng = np.random.default_rng(seed)
    poses = np.tile(POSES, (20, 1, 1))
    poses[:, 1:] += rng.normal(0, 3, (20, 3, 4))
    placed = rng.random((20, 4)) < 0.8
    placed[:, 0] = True
    made = recorded(poses, rng.normal(100, 3, (20, 30)), placed)
    found = told(made)
    assert len(found.weights) == 16
    assert found.weights.sum() == pytest.approx(1)
    assert (np.diff(found.weights) <= 0).all()
    best = int(made.recent().argmax())
    np.testing.assert_array_equal(found.placed[0], placed[best])
    np.testing.assert_array_equal(found.poses[0], np.where(placed[best][:, None], poses[best], 0))
    assert not found.poses[~found.placed].any()


def test_what_cannot_be_decided_does_not_look_certain():
    """Raw odds would: after 40 ticks two true hypotheses are some 20 nats apart."""
    rng = np.random.default_rng(1)
    largest = 0.0
    for _ in range(50):
        poses = np.stack([POSES, POSES])
        exchange(poses[1])
        made = recorded(poses, rng.normal(100, 3 / np.sqrt(2), (2, 40)))
        largest = max(largest, told(made).weights[0])
    assert largest < 0.95


def test_they_go_on_the_wire():
    found = told(with_rival(exchange))
    fields = (found.weights.tobytes(), found.placed.astype(np.uint8).tobytes(), found.poses.astype("<f4").tobytes())
    message = m.Registration(m.VERSION, 7, 3, 0, 0, found.reasons, *fields)
    assert m.decode(m.Registration, m.encode(message), 7) == message
