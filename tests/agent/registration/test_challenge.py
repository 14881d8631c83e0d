"""Which exchanges of identity are tested, and whose cannot all be."""

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.interface.frames import relative_pose, wrap
from agent.interface.sensors import Detector
from agent.registration import places
from agent.registration.challenge import MOST, challenge
from tests import team
from tests.agent.registration.beginning import finished, hovering, recorded, true_poses, window_of


def followed(ticks, names=None, placed=None):
    """One hypothesis that has tracked the truth; under other names, if these are given."""
    names = np.arange(len(ticks[0].truth)) if names is None else names
    track = np.stack([true_poses(tick)[names] for tick in ticks])
    made = recorded(track[-1:], np.zeros((1, len(ticks))), placed)
    made.track[0, -len(ticks) :] = track
    made.bank.P[:] = 1e-4 * np.eye(made.bank.P.shape[1])
    return made


CONFIG = AgentConfig()


def challenged(made, ticks, team=None, config=CONFIG):
    mavs = len(ticks[0].truth)
    team = np.arange(mavs) == 0 if team is None else team
    return finished(challenge(config, made, 0, window_of(ticks).frames[-places.FRAMES :], team))[0]


def circle(seed, mavs, ticks=8):
    angle = 2 * np.pi * np.arange(mavs) / mavs
    at = 1.35 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    return list(team.fly(np.random.default_rng(seed), mavs, ticks, lambda t: at))


@pytest.mark.parametrize("seed", range(5))
def test_of_two_exchanged_names_the_truth_is_tested_first(seed):
    ticks = hovering([1, seed], 5, 8)
    found = challenged(followed(ticks, [0, 1, 4, 3, 2]), ticks)
    truth = true_poses(ticks[-1])
    best = found.rivals[0]
    assert best.placed.all()
    assert np.abs(best.poses[:, :3] - truth[:, :3]).max() < 0.15
    assert np.abs(wrap(best.poses[:, 3] - truth[:, 3])).max() < 0.03
    assert not found.saturated.any()


@pytest.mark.parametrize("seed", range(5))
def test_a_generic_start_has_no_rivals(seed):
    ticks = hovering([2, seed], 6, 8)
    found = challenged(followed(ticks), ticks)
    assert found.rivals == []
    assert not found.saturated.any()


def test_of_three_in_a_circle_all_exchanges_are_tested():
    ticks = circle(3, 3)
    found = challenged(followed(ticks), ticks)
    truth = relative_pose(np.tile(true_poses(ticks[-1])[0], (3, 1)), true_poses(ticks[-1]))
    assert not found.saturated.any()
    assert found.rivals
    for each in found.rivals:
        own = relative_pose(np.tile(each.poses[0], (3, 1)), each.poses)
        apart = np.linalg.norm(own[:, None, :3] - truth[None, :, :3], axis=2)
        assert sorted(apart.argmin(1).tolist()) == [0, 1, 2] or apart.min(1).max() > 0.3


@pytest.mark.parametrize("mavs", [5, 7])
def test_where_more_rivals_are_near_than_may_be_tested_nobody_is_safe(mavs):
    ticks = circle(4, mavs)
    found = challenged(followed(ticks), ticks)
    assert len(found.rivals) <= MOST
    assert found.saturated[1:].all()


def test_where_not_all_rivals_were_looked_for_nobody_is_safe(monkeypatch):
    """However few are known, the next would be as near."""
    ticks = circle(8, 4)
    assert not challenged(followed(ticks), ticks).saturated.any()
    monkeypatch.setattr(places, "BEAM", 3)
    assert challenged(followed(ticks), ticks).saturated[1:].all()


def only_two(ticks, made):
    """What is found of a circle of which all but the last two are known: those may be exchanged, and nothing else."""
    mavs = len(ticks[0].truth)
    found = challenged(made, ticks, np.arange(mavs) < mavs - 2)
    truth = true_poses(ticks[-1])
    moved = [np.linalg.norm(r.poses[:, :3] - truth[:, :3], axis=1) > 0.3 for r in found.rivals]
    assert any(m.tolist() == [False] * (mavs - 2) + [True, True] for m in moved)
    assert not found.saturated.any()


def test_who_is_localised_already_is_beyond_doubt():
    ticks = circle(5, 4)
    only_two(ticks, followed(ticks))


@pytest.mark.parametrize("mavs", [5, 7])
def test_in_a_larger_circle_too(mavs):
    ticks = circle(5, mavs)
    only_two(ticks, followed(ticks))


def line(seed, mavs):
    at = np.column_stack([np.zeros(mavs), np.arange(mavs), np.zeros(mavs)])
    return list(team.fly(np.random.default_rng(seed), mavs, 8, lambda t: at))


@pytest.mark.parametrize("mavs", [4, 5])
def test_two_ends_of_a_line_that_are_localised_do_not_say_which_way_round_it_is(mavs):
    """Turned by half a circle, each end is where the other was: they see one another as before, the rest mirrored."""
    ticks = line(9, mavs)
    ends = np.isin(np.arange(mavs), [0, mavs - 1])
    found = challenged(followed(ticks), ticks, ends)
    truth = true_poses(ticks[-1])
    apart = [np.linalg.norm(r.poses[:, None, :3] - truth[None, :, :3], axis=2).argmin(axis=1) for r in found.rivals]
    assert [0, *range(mavs - 2, 0, -1), mavs - 1] in [each.tolist() for each in apart]


@pytest.mark.parametrize("seed", range(3))
def test_a_station_that_has_its_own_yaw_wrong_may_ask_all_the_same(seed):
    """Turned to where it sees what it sees, it would find nobody of its team on a place."""
    ticks = hovering([10, seed], 6, 8)
    made = followed(ticks)
    made.track[0, :, 0, 3] += 0.7
    assert challenged(made, ticks, np.arange(6) < 4).rivals == []


def test_who_is_not_placed_is_left_out():
    ticks = hovering(6, 5, 8)
    placed = np.array([[True, True, False, True, True]])
    found = challenged(followed(ticks, [0, 3, 2, 1, 4], placed), ticks)
    truth = true_poses(ticks[-1])
    best = found.rivals[0]
    assert best.placed.tolist() == placed[0].tolist()
    assert np.abs(best.poses[[1, 3, 4], :3] - truth[[1, 3, 4], :3]).max() < 0.15


@pytest.mark.parametrize(
    ("unsure", "alone", "saturated"), [(2, True, [2]), (0, True, [1, 2, 3, 4]), (0, False, []), (None, True, [])]
)
def test_whose_detector_is_narrow_must_see_two_while_somebody_has_no_place(unsure, alone, saturated):
    """One, by chance, may be somebody else who is seen from where somebody else stands."""
    ticks = hovering(8, 6, 8)
    made = followed(ticks, placed=np.array([[True, True, True, True, True, False]]))
    if unsure is not None:
        made.explained[0, unsure, np.arange(6) != 4] = 0
    narrow = AgentConfig(detector=Detector(fov_azimuth_rad=6.2))
    team = np.array([True, not alone, False, False, False, False])
    found = challenged(made, ticks, team, narrow)
    assert np.flatnonzero(found.saturated).tolist() == saturated
    assert not challenged(made, ticks, team).saturated.any()


def test_a_record_that_is_shorter_than_the_past_will_do():
    ticks = hovering(7, 4, 8)
    made = followed(ticks, [0, 2, 1, 3])
    made.track[0, :-3] = np.nan
    found = challenged(made, ticks)
    truth = true_poses(ticks[-1])
    assert np.abs(found.rivals[0].poses[:, :3] - truth[:, :3]).max() < 0.2
