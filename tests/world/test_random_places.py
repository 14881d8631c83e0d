"""Are random places where they may be, the same for the same seed, and refused if there are none?"""

import numpy as np
import pytest

from agent.interface.fleet import Fleet
from agent.interface.tables import BadExperiment
from world.clearance import MAX_DRAWS, are_apart, can_be, drawn_until
from world.scenario import Leg, Scenario

BOX = Leg("box", size_m=(8.0, 6.0, 1.5), center=(1, 2, 1.5))
LINE = Leg("line", length_m=6.0)
SHAKEN = Leg("line", length_m=6.0, jitter_m=0.1)


def places(*path: Leg, seed: int = 0, mavs: int = 7) -> np.ndarray:
    """(N, 3): of the last leg."""
    scenario = Scenario(path, Fleet(mavs=mavs, seed=seed))
    return scenario.setpoints(1e5, np.zeros(mavs)).position


def least_distance(p: np.ndarray) -> float:
    return min(float(np.linalg.norm(p[i] - p[j])) for i in range(len(p)) for j in range(i))


def test_boxes_are_filled_and_their_mavs_apart() -> None:
    drawn = np.array([places(BOX, seed=seed) for seed in range(200)])
    assert min(map(least_distance, drawn)) >= 1.0
    share = (drawn - [-3, -1, 0.75]) / [8, 6, 1.5]  # 0 to 1 from wall to wall
    assert 0 <= share.min() < 0.01
    assert 0.99 < share.max() <= 1
    np.testing.assert_allclose(share.mean(axis=(0, 1)), 0.5, atol=0.02)
    assert (share.std(axis=(0, 1)) > 0.28).all()  # uniform: 0.289
    assert np.abs(share.mean(axis=0) - 0.5).max() < 0.06  # no MAV prefers a side


def test_a_box_turns_with_its_heading_and_takes_height_steps() -> None:
    turned = places(Leg("box", size_m=(30.0, 2.0, 1.0), heading_rad=np.pi / 2, height_step_m=2.0))
    assert np.abs(turned[:, 0]).max() <= 1 < 3 < np.ptp(turned[:, 1])
    assert (np.abs(turned[:, 2] - 1.5 - 2 * np.arange(7)) <= 0.5).all()


def test_jitter_has_its_sigma_and_is_drawn_per_leg() -> None:
    far = Leg("line", length_m=60.0, center=(0, 0, 9), jitter_m=0.5)
    off = np.array(
        [places(far, seed=seed) - places(Leg("line", length_m=60.0, center=(0, 0, 9))) for seed in range(99)]
    )
    np.testing.assert_allclose(off.std(axis=(0, 1)), 0.5, atol=4 * 0.5 / np.sqrt(2 * 99 * 7))
    np.testing.assert_allclose(off.mean(axis=(0, 1)), 0, atol=4 * 0.5 / np.sqrt(99 * 7))
    np.testing.assert_allclose(np.corrcoef(off.reshape(99, -1).T) - np.eye(21), 0, atol=0.45)  # all independent
    moved = Scenario((SHAKEN, Leg("line", length_m=6.0, jitter_m=0.1, move_s=5)), Fleet())
    assert np.abs(moved.setpoints(1e5, np.zeros(7)).position - moved.start).max() > 0.05


def test_jitter_is_drawn_again_until_mavs_can_be_there() -> None:
    low_and_close = Leg("line", length_m=4.2, center=(0, 0, 0.35), jitter_m=0.1)
    for seed in range(20):
        drawn = places(low_and_close, seed=seed)
        assert least_distance(drawn) >= 0.6
        assert drawn[:, 2].min() >= 0.3


@pytest.mark.parametrize("leg", [BOX, SHAKEN])
def test_a_seed_gives_the_same_bits_and_another_seed_other_places(leg: Leg) -> None:
    assert np.array_equal(places(leg, seed=3), places(leg, seed=3))
    assert np.abs(places(leg, seed=3) - places(leg, seed=4)).min() > 0
    still = Leg("circle", radius_m=2.0)
    assert np.array_equal(places(still, seed=3), places(still, seed=4))


def test_height_steps_go_up_with_the_number_of_the_mav() -> None:
    stepped = places(LINE, Leg("line", length_m=6.0, center=(0, 0, 2.5), height_step_m=0.15, move_s=2))
    np.testing.assert_allclose(stepped - places(LINE), [[0, 0, 1 + 0.15 * k] for k in range(7)], atol=1e-12)


@pytest.mark.parametrize(
    ("leg", "words"),
    [
        (Leg("box"), r"world.path\[0\]: formation 'box' needs size_m"),
        (Leg("line", length_m=6.0, size_m=(1, 1, 1)), r"\[0\]: formation 'line' does not take size_m"),
        (Leg("box", size_m=(8.0, -1.0, 1.5)), r"world.path\[0\].size_m = \[8.0, -1.0, 1.5\]: expected .* 1000 m"),
        (Leg("box", size_m=(8.0, 8.0, float("nan"))), r"size_m = \[8.0, 8.0, nan\]: expected three, each between"),
        (
            Leg("box", size_m=(1.5, 1.5, 1.5)),
            r"world.path\[0\].size_m = \[1.5, 1.5, 1.5\]: 7 MAVs are never all 1 m apart in it, expected a larger box",
        ),
        (Leg("box", size_m=(8.0, 8.0, 3.0)), r"\[0\]: the box begins at z = 0.00 m, expected at least 0.3 m"),
        (Leg("line", length_m=6.0, jitter_m=-0.1), r"world.path\[0\].jitter_m = -0.1: expected 0 to 1000 m"),
        (Leg("line", length_m=6.0, jitter_m=float("nan")), r"jitter_m = nan: expected 0 to 1000 m"),
        (Leg("line", length_m=3.0, jitter_m=0.1), r"world.path\[0\]: when there MAVs 1 and 2 are 0.50 m apart"),
        (Leg("line", length_m=6.0, height_step_m=-0.3), r"MAV 7 at z = -0.30 m, expected at least 0.3 m"),
        (
            Leg("line", length_m=6.0, height_step_m=float("inf")),
            r"world.path\[0\].height_step_m = inf: expected -1000 to 1000 m",
        ),
    ],
)
def test_impossible_legs(leg: Leg, words: str) -> None:
    with pytest.raises(BadExperiment, match=words):
        places(leg)


def test_a_jitter_that_is_too_large() -> None:
    words = r"world.path\[0\].jitter_m = 50: MAVs always come closer than 0.6 m or lower than 0.3 m, expected a smaller"
    with pytest.raises(BadExperiment, match=words):
        places(Leg("line", length_m=40.0, jitter_m=50.0), mavs=40)  # 2^-40 that none is too low


def test_height_steps_are_subject_to_the_speed_check() -> None:
    with pytest.raises(BadExperiment, match=r"world.path\[1\].move_s = 0.5: the fastest MAV reaches 3.9 m/s and"):
        places(LINE, Leg("line", length_m=6.0, height_step_m=0.15, move_s=0.5))


def test_draws_are_repeated_but_not_for_ever() -> None:
    numbers = iter(range(10 * MAX_DRAWS))
    assert drawn_until(lambda drawn: drawn == 5, lambda: next(numbers), "") == 5
    with pytest.raises(BadExperiment, match=r"^no luck \(in 1000 draws\)$"):
        drawn_until(lambda drawn: drawn < 5, lambda: next(numbers), "no luck")
    assert next(numbers) == MAX_DRAWS + 6


def test_where_mavs_can_be() -> None:
    pair = np.array([[0, 0, 0.3], [0.6, 0, 0.3]])
    assert can_be(pair)
    assert can_be(pair[:1])
    assert not can_be(pair - [0, 0, 0.01])
    assert not can_be(pair * [0.9, 1, 1])
    assert not are_apart(pair, 0.7)
