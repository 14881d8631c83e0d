"""What was heard lately, and where the odometry of those says that they went who were not."""

import numpy as np
import pytest

from agent.interface.frames import compose, inverse, relative_pose, wrap
from agent.registration.window import Window, carried


def test_who_is_not_heard_goes_on_as_he_last_did():
    window = Window(2, 40)
    window.add(0, {0: np.zeros(4), 1: np.array([0.0, 0, 0, 3.0])})
    window.add(1, {0: np.zeros(4), 1: np.array([0.1, 0.2, 0, 3.1])})
    for k in (2, 3):
        frame = window.add(k, {0: np.zeros(4)})
        assert frame.read.tolist() == [True, False]
        np.testing.assert_allclose(frame.odometry[1], [0.1 * k, 0.2 * k, 0, 3.0 + 0.1 * k])


def test_who_coasts_over_the_wrap_does_not_turn_round():
    window = Window(1, 40)
    window.add(0, {0: np.array([0.0, 0, 0, 3.1])})
    window.add(1, {0: np.array([0.0, 0, 0, -3.1])})
    before, frame = window.frames[-1], window.add(2, {})
    turned = wrap(frame.odometry[0, 3] - before.odometry[0, 3])
    assert turned == pytest.approx(2 * np.pi - 6.2)


def test_after_one_reading_only_he_stays():
    window = Window(2, 40)
    window.add(0, {0: np.zeros(4), 1: np.ones(4)})
    np.testing.assert_array_equal(window.add(1, {0: np.zeros(4)}).odometry[1], np.ones(4))


def test_who_was_never_heard_is_not_read_and_spoils_nothing():
    window = Window(2, 40)
    for k in range(3):
        frame = window.add(k, {0: np.ones(4)})
        assert frame.read.tolist() == [True, False]
        assert np.isfinite(frame.odometry).all()


def test_sets_are_put_whatever_their_length():
    rng = np.random.default_rng(0)
    frame = Window(3, 40).add(0, {i: np.zeros(4) for i in range(3)})
    sets = {1: rng.random((2, 3)), 0: rng.random((4, 3)), 2: rng.random((0, 3))}
    for station, spherical in sets.items():
        frame.put(station, spherical)
    assert frame.spherical.shape == (3, 4, 3)
    for station, spherical in sets.items():
        np.testing.assert_array_equal(frame.spherical[station, : len(spherical)], spherical)
        assert np.isnan(frame.spherical[station, len(spherical) :]).all()
    assert frame.heard.all()


def test_an_empty_set_is_heard_all_the_same():
    frame = Window(2, 40).add(0, {0: np.zeros(4), 1: np.zeros(4)})
    frame.put(1, np.zeros((0, 3)))
    assert frame.heard.tolist() == [False, True]


def test_old_frames_are_let_go_and_the_others_are_found_by_tick():
    window = Window(1, 5)
    assert window.at(0) is None
    for k in range(20, 29):
        window.add(k, {0: np.zeros(4)})
    assert [f.tick for f in window.frames] == [24, 25, 26, 27, 28]
    assert [None if (f := window.at(k)) is None else f.tick for k in (23, 24, 28, 29)] == [None, 24, 28, None]


@pytest.mark.parametrize("seed", range(10))
def test_carried_goes_with_the_odometry_frame(seed):
    """A pose and the odometry reading at one time tell where the odometry frame is, so the reading at another tells the
    pose then."""
    rng = np.random.default_rng([1, seed])
    poses, there, here = (np.column_stack([rng.normal(size=(6, 3)) * 4, rng.uniform(-9, 9, 6)]) for _ in range(3))
    frames = compose(poses, inverse(there))
    found = carried(poses, there, here)
    expected = compose(frames, here)
    np.testing.assert_allclose(found[:, :3], expected[:, :3], atol=1e-12)
    np.testing.assert_allclose(wrap(found[:, 3] - expected[:, 3]), 0, atol=1e-12)
    np.testing.assert_allclose(relative_pose(carried(found, here, there), poses), 0, atol=1e-12)


def test_what_is_late_is_put_into_its_tick():
    window = Window(2, 10)
    for k in range(4):
        window.add(k, {0: np.zeros(4)} | ({1: np.full(4, 0.1 * k)} if k < 2 else {}))
    frame = window.at(2)
    np.testing.assert_allclose(frame.odometry[1], 0.2)  # a guess
    frame.put_odometry(1, np.full(4, 0.5))
    window.settle(frame)
    assert frame.read.all()
    np.testing.assert_array_equal(frame.odometry[1], np.full(4, 0.5))
    window.settle(window.at(3))  # goes on from there
    np.testing.assert_allclose(window.at(3).odometry[1], 0.9)
    assert not window.at(3).read[1]


def test_what_was_lost_lies_between_the_readings_before_and_after():
    window = Window(2, 10)
    for k in range(6):
        window.add(k, {0: np.zeros(4)} | ({1: np.array([0.1 * k * k, 0, 0, 3.0 + 0.1 * k])} if k in (0, 1, 5) else {}))
    window.at(5).odometry[1, 3] -= 2 * np.pi
    for k in (2, 3, 4):
        window.settle(window.at(k))
        assert window.at(k).read[1]
        np.testing.assert_allclose(window.at(k).odometry[1, :3], [0.1 + 0.6 * (k - 1), 0, 0])
        assert wrap(window.at(k).odometry[1, 3] - 3.0 - 0.1 * k) == pytest.approx(0, abs=1e-9)


def test_a_silence_that_was_gone_through_as_a_guess_is_a_chord_once_it_ends():
    window = Window(2, 20)
    x = {0: 0.0, 1: 0.1, 8: 1.5}  # of the MAV that is heard at these ticks
    for k in range(9):
        window.add(k, {0: np.zeros(4)} | ({1: np.array([x[k], 0, 0, 0])} if k in x else {}))
        window.settle(window.at(k))
    np.testing.assert_allclose([f.odometry[1, 0] for f in window.frames[1:]], 0.1 + 0.2 * np.arange(8))
    assert all(f.read[1] for f in window.frames)
