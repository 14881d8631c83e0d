"""Joint placements from nothing, against the truth."""

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.interface.frames import wrap
from agent.interface.sensors import Detector
from agent.registration import views
from agent.registration.candidates import Candidates
from agent.registration.proposals import FIELD_FRAMES, _field, propose
from agent.registration.window import carried
from tests import team
from tests.agent.registration.beginning import (
    exact,
    finished,
    hovering,
    order,
    placement,
    true_poses,
    wandering,
    window_of,
)

CONFIG = AgentConfig()


def proposed(ticks, station=1, base=None, most=8, config=CONFIG):
    mavs = len(ticks[0].truth)
    base = placement(true_poses(ticks[-1], station), np.arange(mavs) == 0) if base is None else base
    missing = [j for j in range(mavs) if not base.placed[j]]
    return finished(propose(config, window_of(ticks, station).frames, base, missing, most))[0].placements


def is_true(found, truth):
    """Whether everybody is placed, and well enough for the filter to begin with."""
    apart = np.linalg.norm(found.poses[:, :3] - truth[:, :3], axis=1)
    turned = np.abs(wrap(found.poses[:, 3] - truth[:, 3]))
    return found.placed.all() and (apart < 0.5).all() and (turned < 0.1).all()


@pytest.mark.parametrize("fly", [hovering, wandering])
@pytest.mark.parametrize("seed", range(8))
def test_of_a_random_box_the_truth_comes_first(fly, seed):
    ticks = fly([1, seed], 6, 8)
    station = 1 + seed % 6
    assert is_true(proposed(ticks, station)[0], true_poses(ticks[-1], station))


@pytest.mark.parametrize("seed", range(3))
def test_with_many_misses_and_false_detections_it_is_still_among_them(seed):
    detector = Detector(P_D=0.7, false_per_set=1.0)
    ticks = hovering([2, seed], 6, 8, detector=detector)
    found = proposed(ticks, config=AgentConfig(detector=detector))
    assert any(is_true(each, true_poses(ticks[-1])) for each in found)


def strangers(ticks, one, other):
    """The same ticks, but that the two never see each other."""
    for tick in ticks:
        for mav, unseen in ((one, other), (other, one)):
            tick.sets[mav] = tick.sets[mav][tick.labels[mav] != unseen]
    return ticks


@pytest.mark.parametrize("seed", range(6))
def test_whom_the_station_never_sees_is_found_by_the_others(seed):
    ticks = strangers(hovering([3, seed], 5, 8), 1, 4)
    assert is_true(proposed(ticks)[0], true_poses(ticks[-1]))


def closest(found):
    """How near two of those come who are placed, m."""
    places = found.poses[found.placed, :3]
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    return apart[np.triu_indices(len(places), 1)].min()


@pytest.mark.parametrize("seed", range(4))
def test_no_two_mavs_are_in_one_place(seed):
    """Nor in the regular circle, where everybody might be everywhere."""
    rng = np.random.default_rng([4, seed])
    angle = 2 * np.pi * np.arange(5) / 5
    places = 1.35 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    ticks = list(team.fly(rng, 5, 8, lambda t: places))
    found = proposed(ticks, most=16)
    assert len(found) > 4
    assert min(map(closest, found)) > 0.25


def doubled():
    """What is proposed of a team of which one has two names."""
    ticks = list(exact(np.random.default_rng(8), 4, 8, moving=False))
    for tick in ticks:
        tick.odometry[4], tick.sets[4] = tick.odometry[3], tick.sets[3]
    return proposed(ticks)


def test_of_two_that_see_the_same_from_one_place_only_one_is_there():
    assert closest(doubled()[0]) > 0.25


def test_nor_are_both_there_in_those_that_are_less_good():
    assert min(map(closest, doubled())) > 0.25


def test_the_field_is_what_each_two_see_of_one_another():
    """Mean over the last frames, from both sides; of two places of one MAV there is nothing to say."""
    ticks = wandering(9, 4, 8)
    frames, truth = window_of(ticks).frames[-FIELD_FRAMES:], true_poses(ticks[-1])
    mav = np.array([0, 1, 2, 3, 3])
    poses = np.vstack([truth, truth[3] + [0.5, 0, 0, 1]])
    sigma = np.array([0.05, 0.05, 0.05, 0.02])
    nodes = Candidates(mav, poses, np.tile(np.diag(sigma**2), (5, 1, 1)))
    field = finished(_field(CONFIG, frames, nodes))[0]
    expected = np.zeros((5, 5))
    for frame in frames:
        there = carried(poses, frames[-1].odometry[mav], frame.odometry[mav])
        for i, j in np.ndindex(5, 5):
            now, then = (views.predicted(p[i, :3], p[j, :3]) for p in (poses, there))
            G = views.axes(now)
            variances = 2 * sigma[0] ** 2 * (G * G).sum(-1) + views.noise(CONFIG.detector, now[0])
            variances[1] += sigma[3] ** 2
            seen = views.log_seen(CONFIG.detector, then, there[i, 3], variances, frame.spherical[mav[i]])
            expected[i, j] += seen / len(frames)
    apart = mav[:, None] != mav
    np.testing.assert_allclose(field[apart], (expected + expected.T)[apart], atol=1e-9)
    assert (field[~apart] == -np.inf).all()


def test_best_first_no_more_than_asked_for_and_the_base_is_kept():
    ticks = hovering(5, 5, 8)
    truth = true_poses(ticks[-1])
    base = placement(truth, np.arange(5) < 3)
    found = proposed(ticks, base=base, most=2)
    assert 1 <= len(found) <= 2
    for each in found:
        assert each.placed[:3].all()
        np.testing.assert_array_equal(each.poses[:3], truth[:3])
    assert is_true(found[0], truth)


def test_where_nothing_is_seen_nobody_is_placed():
    ticks = list(exact(np.random.default_rng(6), 3, 8))
    for tick in ticks:
        for mav in order(3):
            tick.sets[mav] = np.zeros((0, 3))
    assert [each.placed.tolist() for each in proposed(ticks)] == [[True, False, False]]


def test_what_it_says_that_it_costs_grows_with_the_team():
    costs = []
    for mavs in (3, 6):
        ticks = hovering(7, mavs, 8)
        base = placement(true_poses(ticks[-1]), np.arange(mavs) == 0)
        job = propose(CONFIG, window_of(ticks).frames, base, list(range(1, mavs)), 8)
        costs.append(finished(job)[1])
    assert 0 < 1.5 * costs[0] < costs[1]
