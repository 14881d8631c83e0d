"""Where a MAV might be, from sightings of one another."""

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.interface.frames import compose, direction, range_and_bearing, relative_pose, wrap
from agent.interface.sensors import Detector, Odometry
from agent.registration.candidates import ENOUGH, candidates, seen_from_station
from tests.agent.registration.beginning import exact, finished, hovering, placement, true_poses, window_of

CONFIG = AgentConfig()


def found_in(ticks, base, missing, config=CONFIG, station=1):
    return finished(candidates(config, window_of(ticks, station).frames, base, missing))[0]


def nearest(found, mav, truth):
    """How far the best candidate of a MAV is off, m and rad."""
    poses = found.poses[found.mav == mav]
    distance = np.linalg.norm(poses[:, :3] - truth[:3], axis=1) + np.abs(wrap(poses[:, 3] - truth[3]))
    best = poses[distance.argmin()]
    return np.linalg.norm(best[:3] - truth[:3]), abs(wrap(best[3] - truth[3]))


@pytest.mark.parametrize("moving", [False, True], ids=["in hover", "while both move"])
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("station", [1, 2])
def test_perfect_sightings_of_one_another_give_the_pose(moving, seed, station):
    ticks = list(exact(np.random.default_rng([1, seed]), 2, 8, moving))
    truth = true_poses(ticks[-1], station)
    found = found_in(ticks, placement(truth, [True, False]), [1], station=station)
    assert found.mav.tolist() == [1]
    off = found.poses[0] - truth[1]
    assert np.abs(off[:3]).max() < 1e-9
    assert abs(wrap(off[3])) < 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_in_a_crowd_the_truth_is_among_the_candidates(seed):
    ticks = list(exact(np.random.default_rng([2, seed]), 6, 6))
    truth = true_poses(ticks[-1])
    found = found_in(ticks, placement(truth, np.arange(6) == 0), [1, 2, 3, 4, 5])
    for mav in range(1, 6):
        distance, turn = nearest(found, mav, truth[mav])
        assert distance < 1e-6
        assert turn < 1e-6


def seen_by(tick, station, *targets):
    """What a MAV sees of others, without noise."""
    at = tick.truth[[mav - 1 for mav in targets]]
    return range_and_bearing(relative_pose(np.tile(tick.truth[station - 1], (len(at), 1)), at)[:, :3])


@pytest.mark.parametrize("seed", range(5))
def test_of_detectors_that_do_not_look_all_around_one_sees_and_another_is_seen(seed):
    """MAV 1 sees 2 and 3, of whom 3 sees 2 only, and 2 nobody."""
    ticks = list(exact(np.random.default_rng([9, seed]), 3, 8))
    for tick in ticks:
        tick.sets.update({1: seen_by(tick, 1, 3, 2), 2: np.zeros((0, 3)), 3: seen_by(tick, 3, 2)})
    truth, narrow = true_poses(ticks[-1]), AgentConfig(detector=Detector(fov_azimuth_rad=4.0))
    base = placement(truth, [True, True, False])
    distance, turn = nearest(found_in(ticks, base, [2], narrow), 2, truth[2])
    assert distance < 1e-6
    assert turn < 1e-6
    assert not len(found_in(ticks, placement(truth, [True, False, False]), [2], narrow).mav)  # 2 is not placed
    assert not len(found_in(ticks, base, [2]).mav)  # with detectors that look all around it would see 1


@pytest.mark.parametrize("deaf", [1, 2])
def test_who_sees_but_is_not_seen_has_no_place(deaf):
    ticks = list(exact(np.random.default_rng(3), 2, 8))
    for tick in ticks:
        tick.sets[deaf] = np.zeros((0, 3))
    found = found_in(ticks, placement(true_poses(ticks[-1]), [True, False]), [1])
    assert not len(found.mav)


def test_sightings_must_agree_in_range_and_in_elevation():
    for spoil in ([3.0, 0, 0], [0, 0, 0.06]):
        ticks = list(exact(np.random.default_rng(4), 2, 8))
        for tick in ticks:
            tick.sets[2] = tick.sets[2] + spoil
        found = found_in(ticks, placement(true_poses(ticks[-1]), [True, False]), [1])
        assert not len(found.mav)


def test_one_frame_is_not_enough():
    ticks = list(exact(np.random.default_rng(5), 2, 8))
    for tick in ticks[1:]:
        tick.sets[2] = np.zeros((0, 3))
    base = placement(true_poses(ticks[-1]), [True, False])
    assert not len(found_in(ticks, base, [1]).mav)


@pytest.mark.parametrize("seed", range(20))
def test_clutter_does_not_survive_several_frames(seed):
    """Two MAVs that see nothing but false detections, four a set."""
    rng = np.random.default_rng([6, seed])
    ticks = list(exact(rng, 2, 8))
    for tick in ticks:
        for mav in (1, 2):
            tick.sets[mav] = np.column_stack(
                [12 * rng.random(4) ** (1 / 3), rng.uniform(-np.pi, np.pi, 4), np.arcsin(rng.uniform(-1, 1, 4))]
            )
    assert not len(found_in(ticks, placement(true_poses(ticks[-1]), [True, False]), [1]).mav)


@pytest.mark.parametrize("seed", range(10))
def test_noise_misses_and_clutter_leave_the_truth_among_few(seed):
    ticks = hovering([7, seed], 5, 8)
    truth = true_poses(ticks[-1])
    found = found_in(ticks, placement(truth, np.arange(5) == 0), [1, 2, 3, 4])
    for mav in range(1, 5):
        distance, turn = nearest(found, mav, truth[mav])
        assert distance < 0.5
        assert turn < 0.1
        assert (found.mav == mav).sum() <= 10


def squares(elevation, n=60):
    """Normalised squared errors of the truth's candidate, without drift: along the line of sight, across, of yaw."""
    line, still, found = direction(0.3, elevation), Odometry(position_sigma_m=0, yaw_sigma_rad=0), []
    eyes = Detector(false_per_set=1e-6)
    for seed in range(n):
        ticks = hovering([8, seed], 2, 8, places=[np.zeros(3), 2.5 * line], detector=eyes, odometry=still)
        truth, config = true_poses(ticks[-1]), AgentConfig(detector=eyes, odometry=still)
        made = found_in(ticks, placement(truth, [True, False]), [1], config)
        off, C = made.poses[0] - truth[1], made.covariances[0]
        sight = truth[1, :3] / np.linalg.norm(truth[1, :3])
        along = (off[:3] @ sight) ** 2 / (sight @ C[:3, :3] @ sight)
        across = off[:3] @ np.linalg.solve(C[:3, :3], off[:3]) - along
        found.append([along, across / 2, wrap(off[3]) ** 2 / C[3, 3]])
    return np.mean(found, axis=0)


@pytest.mark.statistical
def test_a_candidate_knows_how_far_it_is_off():
    along, across, yaw = squares(elevation=0.3)
    assert 0.6 < along < 1.5
    assert 0.5 < across < 1.3  # elevation is measured from both sides
    assert 0.6 < yaw < 1.6


@pytest.mark.statistical
def test_a_candidate_right_above_knows_that_its_yaw_is_unsure():
    assert squares(elevation=1.2)[2] < 2


def test_who_is_placed_already_helps_to_find_the_next():
    """MAV 1 does not see MAV 3; MAV 2, whose place is known, does."""
    ticks = list(exact(np.random.default_rng(9), 3, 8))
    for tick in ticks:
        tick.sets[1] = tick.sets[1][:0]
    truth = true_poses(ticks[-1])
    assert not len(found_in(ticks, placement(truth, [True, False, False]), [2]).mav)
    found = found_in(ticks, placement(truth, [True, True, False]), [2])
    assert nearest(found, 2, truth[2])[0] < 1e-9


def test_what_is_looked_for_costs_no_more_in_a_regular_circle_whose_places_are_all_alike():
    """Of eleven placed MAVs each sees the last one in many places; a slice that took them all took seconds."""
    angle = np.arange(12) * np.pi / 6
    ticks = hovering(10, 12, 8, places=np.column_stack([2.7 * np.cos(angle), 2.7 * np.sin(angle), 0 * angle]))
    truth, frames = true_poses(ticks[-1]), window_of(ticks).frames
    placed = np.arange(12) < 11
    assert max(candidates(CONFIG, frames, placement(truth, placed), [11])) < 1.5 * ENOUGH**2
    assert nearest(found_in(ticks, placement(truth, placed), [11]), 11, truth[11])[0] < 0.2


def test_whose_set_was_not_heard_is_left_out():
    ticks = list(exact(np.random.default_rng(10), 2, 8))
    window = window_of(ticks)
    for frame in window.frames[:-1]:
        frame.heard[1] = False
    base = placement(true_poses(ticks[-1]), [True, False])
    assert not len(finished(candidates(CONFIG, window.frames, base, [1]))[0].mav)


def test_everybody_moves_with_the_station():
    ticks = list(exact(np.random.default_rng(11), 4, 2))
    truth, frame = true_poses(ticks[-1]), window_of(ticks).frames[-1]
    elsewhere = np.column_stack([np.zeros((4, 3)), np.full(4, 0.7)])
    shifted = compose(elsewhere + np.array([1, 2, 3, 0]), truth)
    found = seen_from_station(placement(shifted), frame)
    np.testing.assert_allclose(relative_pose(found.poses, truth), 0, atol=1e-12)
