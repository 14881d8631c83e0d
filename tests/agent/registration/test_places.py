"""Who may stand in whose place, against a search over all yaws and all permutations."""

from itertools import permutations

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.interface.frames import relative_pose, wrap
from agent.interface.sensors import Detector
from agent.registration import places, views
from agent.registration.places import PlaceView, place_view, rivals
from tests.agent.registration.beginning import finished, hovering, true_poses, wandering, window_of

CONFIG = AgentConfig()


def viewed(ticks, track, P=None):
    """The place view of everybody, on a track (F, N, 4)."""
    mavs = track.shape[1]
    P = np.zeros((mavs, 3, mavs, 3)) if P is None else P
    return finished(place_view(CONFIG, window_of(ticks).frames, np.arange(mavs), track, P))[0]


def tracked(ticks):
    return np.stack([true_poses(tick) for tick in ticks])


def exchanged(track, one, other):
    """The same places, but two of the MAVs have each other's."""
    track = track.copy()
    track[:, [one, other]] = track[:, [other, one]]
    return track


YAWS = np.arange(-np.pi, np.pi, 1e-3)


def for_every_yaw(frames, track, j, place):
    """Log-likelihood of what MAV j has seen, had it stood there with each of these yaws."""
    total = np.zeros(len(YAWS))
    for frame, poses in zip(frames, track, strict=True):
        yaw = YAWS + frame.odometry[j, 3] - frames[-1].odometry[j, 3]
        for target in set(range(len(poses))) - {place}:
            seen = views.predicted(poses[place, :3], poses[target, :3])
            G = views.axes(seen)
            variances = views.noise(CONFIG.detector, seen[0]) + 2 * places.PLACE_SIGMA_M**2 * (G * G).sum(-1)
            every, of = (np.tile(each, (len(YAWS), 1)) for each in (seen, variances))
            total += views.log_seen(CONFIG.detector, every, yaw, of, frame.spherical[j])
    return total


@pytest.mark.parametrize("seed", range(3))
def test_the_view_is_the_best_likelihood_over_all_yaws(seed):
    """On the own place; on others, where nothing fits really, no more than that."""
    ticks = hovering([1, seed], 3, 4)
    track, frames = tracked(ticks), window_of(ticks).frames
    view = viewed(ticks, track)
    for j in range(3):
        for place in range(3):
            total = for_every_yaw(frames, track, j, place)
            assert view.V[j, place] < total.max() + 1.0
            if j == place:
                assert view.V[j, place] > total.max() - 1.0
                assert abs(wrap(view.yaw[j, place] - YAWS[total.argmax()])) < 3e-3


@pytest.mark.parametrize("fly", [hovering, wandering])
@pytest.mark.parametrize("seed", range(5))
def test_everybody_fits_his_own_place_best_and_the_yaw_is_found(fly, seed):
    ticks = fly([2, seed], 6, 8)
    track = tracked(ticks)
    wrong = track.copy()
    wrong[..., 3] += np.random.default_rng(seed).uniform(-3, 3, 6)  # the yaws of a hypothesis do not matter
    view = viewed(ticks, wrong)
    assert (view.V.argmax(1) == np.arange(6)).all()
    off = wrap(view.yaw.diagonal() - track[-1, :, 3])
    assert np.abs(off).max() < 0.02


@pytest.mark.parametrize("fly", [hovering, wandering])
@pytest.mark.parametrize("seed", range(5))
def test_of_two_exchanged_names_the_best_rival_is_the_truth(fly, seed):
    ticks = fly([3, seed], 5, 8)
    track = tracked(ticks)
    wrong = exchanged(track, 2, 4)
    found = rivals(viewed(ticks, wrong), wrong[-1], within=120.0)
    truth = track[-1]
    assert found.behind[0] == 0
    assert np.abs(found.poses[0, :, :3] - truth[:, :3]).max() < 0.15
    assert np.abs(wrap(found.poses[0, :, 3] - truth[:, 3])).max() < 0.03


@pytest.mark.parametrize("seed", range(5))
def test_who_is_exchanged_with_the_station_is_found_too(seed):
    """The station stays where its odometry says, so everybody else moves."""
    ticks = hovering([4, seed], 5, 8)
    track = tracked(ticks)
    wrong = exchanged(track, 0, 3)
    found = rivals(viewed(ticks, wrong), track[-1][[3, 1, 2, 0, 4]], within=120.0)
    best = relative_pose(np.tile(found.poses[0, 0], (5, 1)), found.poses[0])
    truth = relative_pose(np.tile(track[-1, 0], (5, 1)), track[-1])
    assert np.abs(best[:, :3] - truth[:, :3]).max() < 0.2
    np.testing.assert_allclose(found.poses[:, 0], np.tile(track[-1, 3], (len(found.poses), 1)), atol=1e-9)


def test_who_was_not_heard_may_be_anywhere():
    ticks = hovering(5, 4, 8)
    window = window_of(ticks)
    for frame in window.frames:
        frame.heard[2] = False
    job = place_view(CONFIG, window.frames, np.arange(4), tracked(ticks), np.zeros((4, 3, 4, 3)))
    view = finished(job)[0]
    assert np.ptp(view.V[2]) == 0
    assert (view.V.argmax(1) == np.arange(4))[[0, 1, 3]].all()


@pytest.mark.parametrize("fov_azimuth_rad", [1.0, 2 * np.pi])
def test_who_sees_nobody_may_stand_anywhere_unless_it_looks_all_around(fov_azimuth_rad):
    ticks = hovering(6, 4, 8, detector=Detector(P_D=0.9, false_per_set=1e-6))
    for tick in ticks:
        tick.sets[3] = np.zeros((0, 3))
    config = AgentConfig(detector=Detector(fov_azimuth_rad=fov_azimuth_rad))
    frames = window_of(ticks).frames
    view = finished(place_view(config, frames, np.arange(4), tracked(ticks), np.zeros((4, 3, 4, 3))))[0]
    looks_away = fov_azimuth_rad < 2  # from all three others there is such a direction
    assert (view.V[2] == (0.0 if looks_away else places.NO_YAW)).all()


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("seed", range(6))
def test_assignments_are_all_permutations_near_the_best(n, seed):
    rng = np.random.default_rng([6, seed, n])
    V, poses = rng.normal(0, 40, (n, n)), rng.normal(size=(n, 4))
    within = float(rng.choice([10.0, 60.0, 300.0]))
    found = rivals(PlaceView(V, np.tile(poses[:, 3], (n, 1))), poses, within)
    score = np.array([V[np.arange(n), list(p)].sum() for p in permutations(range(n))])
    expected = np.sort(score.max() - score)
    np.testing.assert_allclose(found.behind, expected[expected <= within], atol=1e-9)
    assert found.known_to == np.inf


@pytest.mark.parametrize("seed", range(6))
def test_each_permutation_stands_where_it_says_and_has_the_yaws_seen_there(seed):
    rng = np.random.default_rng([7, seed])
    V, poses, yaw = rng.normal(0, 10, (4, 4)), rng.normal(size=(4, 4)) * 3, rng.uniform(-3, 3, (4, 4))
    found = rivals(PlaceView(V, yaw), poses, 1e3)
    every = np.arange(4)
    ranked = sorted(permutations(range(4)), key=lambda p: -V[every, list(p)].sum())
    assert len(found.poses) == 24
    for p, placed in zip(ranked, found.poses, strict=True):
        expected = np.column_stack([poses[list(p), :3], yaw[every, list(p)]])
        off = relative_pose(np.tile(placed[0], (4, 1)), placed) - relative_pose(np.tile(expected[0], (4, 1)), expected)
        off[:, 3] = wrap(off[:, 3])
        np.testing.assert_allclose(off, 0, atol=1e-9)
        np.testing.assert_allclose(relative_pose(placed[0], poses[0]), 0, atol=1e-9)


def test_where_there_are_too_many_it_says_up_to_where_it_knows():
    """All 5040 permutations of seven are alike."""
    found = rivals(PlaceView(np.zeros((7, 7)), np.zeros((7, 7))), np.zeros((7, 4)), 120.0)
    assert len(found.behind) == places.BEAM
    assert found.known_to == 0


@pytest.mark.parametrize("seed", range(4))
def test_up_to_where_it_says_it_knows_all(seed):
    rng = np.random.default_rng([8, seed])
    V = rng.normal(0, 4, (6, 6))
    found = rivals(PlaceView(V, np.zeros((6, 6))), np.zeros((6, 4)), 60.0)
    score = np.array([V[np.arange(6), list(p)].sum() for p in permutations(range(6))])
    behind = np.sort(score.max() - score)
    assert found.known_to < 60
    np.testing.assert_allclose(found.behind[found.behind < found.known_to], behind[behind < found.known_to], atol=1e-9)


def test_if_the_beam_keeps_nobody_who_comes_to_an_end_nothing_is_known():
    """Seven MAVs of which nobody can be on one place but the one with the most doubts, so the beam fills up without."""
    rng = np.random.default_rng(0)
    V = -rng.uniform(0, 40, (7, 7))
    V[:, 2], V[1, 2] = -2000.0, -90.0
    V[2, 2] = -1300.0
    found = rivals(PlaceView(V, np.zeros((7, 7))), np.zeros((7, 4)), within=241.0)
    assert len(found.behind) >= 1
    assert found.known_to < 241.0
