"""Are paths smooth, formations as described, and impossible legs refused with exact words?"""

import msgspec
import numpy as np
import pytest

from agent.interface.fleet import Fleet
from agent.interface.tables import BadExperiment
from world.clearance import PEAK_ACCELERATION, PEAK_SPEED
from world.scenario import Leg, Scenario

YAW = np.zeros(7)
CIRCLE = Leg("circle", radius_m=1.35, hold_s=2)
LINE = Leg("line", length_m=12.0, move_s=6, hold_s=1)


def slots(leg: Leg, mavs: int = 7) -> np.ndarray:
    return Scenario((msgspec.structs.replace(leg, move_s=0.0),), Fleet(mavs=mavs)).start


def test_the_papers_paths_can_be_flown() -> None:
    circle, line, v = ("circle", "radius_m", 1.35), ("line", "length_m", 6.0), ("v", "length_m", 6.0)
    wide, long = ("circle", "radius_m", 2.7), ("line", "length_m", 12.0)
    for sequence in (
        [circle, wide, circle, wide, circle],
        [circle, v, long, circle, line],
        [line, long, v, line],
        [line, circle, wide, long, line],
    ):
        legs = [
            Leg(formation, **{size: value}, move_s=6.0 if k else 0.0, hold_s=2.0)
            for k, (formation, size, value) in enumerate(sequence)
        ]
        Scenario(tuple(legs), Fleet())


def test_formations_have_their_size_and_run_from_left_to_right() -> None:
    circle, line = slots(Leg("circle", radius_m=2.7, center=(1, 2, 3))), slots(Leg("line", length_m=12.0))
    np.testing.assert_allclose(np.linalg.norm(circle - [1, 2, 3], axis=1), 2.7)
    np.testing.assert_allclose(line, [[0, 6 - 2 * k, 1.5] for k in range(7)], atol=1e-12)
    v = slots(Leg("v", length_m=4.0))
    assert np.linalg.norm(v[0] - v[3]) == pytest.approx(4.0)  # MAV 4 is the tip
    assert np.dot(v[0] - v[3], v[6] - v[3]) == pytest.approx(0.0, abs=1e-12)
    grid = slots(Leg("grid", spacing_m=2.0), mavs=6)
    np.testing.assert_allclose(grid, [[x, y, 1.5] for y in (2, 0, -2) for x in (1, -1)], atol=1e-12)
    for places in (circle, line, v, grid):
        assert (np.diff(places[:, 1]) < 1e-9).all()
    np.testing.assert_allclose(
        slots(Leg("line", length_m=12.0, heading_rad=np.pi / 2))[0], [-6, 0, 1.5], atol=1e-12
    )  # heading along y: left is -x
    assert slots(Leg("line", length_m=12.0), mavs=1).tolist() == [[0, 0, 1.5]]


def test_setpoints_are_derivatives_of_each_other_and_at_rest_at_both_ends() -> None:
    scenario, h = Scenario((CIRCLE, LINE), Fleet()), 1e-5
    for time_s in (0.5, 2.01, 3.3, 5.0, 7.9, 8.5):
        before, now, after = (scenario.setpoints(time_s + dt, YAW) for dt in (-h, 0, h))
        np.testing.assert_allclose((after.position - before.position) / (2 * h), now.velocity, atol=1e-7)
        np.testing.assert_allclose((after.velocity - before.velocity) / (2 * h), now.acceleration, atol=1e-7)
    for end_s in (2.0, 8.0):
        for side in (-1e-4, 1e-4):
            setpoints = scenario.setpoints(end_s + side, YAW)
            assert np.abs(setpoints.velocity).max() < 1e-9
            assert np.abs(setpoints.acceleration).max() < 1e-5  # the jerk is zero too: it grows with the square
    np.testing.assert_allclose(scenario.setpoints(1e4, YAW).position, slots(LINE), atol=1e-12)


def test_the_peaks_are_what_the_check_says() -> None:
    scenario = Scenario((CIRCLE, LINE), Fleet())
    flown = [scenario.setpoints(t, YAW) for t in np.linspace(2, 8, 6001)]
    distance = np.linalg.norm(slots(LINE) - slots(CIRCLE), axis=1).max()
    speed, acceleration = (
        max(np.linalg.norm(getattr(each, name), axis=1).max() for each in flown)
        for name in ("velocity", "acceleration")
    )
    assert speed == pytest.approx(PEAK_SPEED * distance / 6, rel=1e-6)
    assert acceleration == pytest.approx(PEAK_ACCELERATION * distance / 36, rel=1e-6)


@pytest.mark.parametrize("mavs", [2, 7, 20])
def test_a_line_can_follow_and_precede_any_formation(mavs: int) -> None:
    """Because all formations run from left to right, whatever the shape."""
    line = Leg("line", length_m=1.0 * (mavs - 1), move_s=60)
    wide = Leg("circle", radius_m=1.2 * mavs / 6, move_s=60)
    arrow, grid = Leg("v", length_m=1.0 * mavs, move_s=60), Leg("grid", spacing_m=1.0, move_s=60)
    first = Leg("line", length_m=1.0 * (mavs - 1))
    Scenario((first, wide, line, arrow, line, grid, line), Fleet(mavs=mavs))


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ((Leg("circle"),), r"world.path\[0\]: formation 'circle' needs radius_m"),
        ((Leg("circle", radius_m=2.0, length_m=1.0),), r"\[0\]: formation 'circle' does not take length_m"),
        ((Leg("v", length_m=-1.0),), r"world.path\[0\].length_m = -1: expected between 0 and 1000 m"),
        ((Leg("points", points=((0, 0, 0),)),), r"world.path\[0\].points: 1 points, expected 7, one per MAV"),
        ((Leg("circle", radius_m=2.0, center=(0, 0, float("nan"))),), "must be finite"),
        ((Leg("circle", radius_m=2.0, center=(0, 0, 0.1)),), r"MAV 1 at z = 0.10 m, expected at least 0.3 m"),
        ((Leg("circle", radius_m=2.0, move_s=1.0),), r"world.path\[0\].move_s = 1: the first leg is where"),
        ((CIRCLE, Leg("line", length_m=9.0, move_s=5, hold_s=-1)), r"world.path\[1\].hold_s = -1: expected 0 to"),
        ((Leg("line", length_m=3.0),), r"world.path\[0\]: when there MAVs 1 and 2 are 0.50 m apart, .* 0.6 m"),
        ((CIRCLE, Leg("line", length_m=12.0)), r"world.path\[1\].move_s = 0: the fastest MAV must move 4.69 m"),
        (
            (CIRCLE, Leg("circle", radius_m=1.35, center=(8, 0, 1.5), move_s=2)),
            r"move_s = 2: the fastest MAV reaches 8.8 m/s and 15.0 m/s\^2, at most 5 m/s and 5 m/s\^2 are allowed; "
            r"move_s = 3.5 would do",
        ),
        ((CIRCLE, Leg("circle", radius_m=1.35, heading_rad=np.pi, move_s=9)), "on the straight way there MAVs"),
    ],
)
def test_impossible_legs(path: tuple[Leg, ...], words: str) -> None:
    with pytest.raises(BadExperiment, match=words):
        Scenario(path, Fleet())


def test_the_move_that_is_proposed_would_do() -> None:
    for move_s, fits in ((3.4, False), (3.5, True)):
        path = (CIRCLE, Leg("circle", radius_m=1.35, center=(8, 0, 1.5), move_s=move_s))
        if fits:
            Scenario(path, Fleet())
        else:
            with pytest.raises(BadExperiment):
                Scenario(path, Fleet())


def test_meeting_on_the_way_is_found_wherever_a_fine_search_finds_it() -> None:
    draw, found = np.random.default_rng(3), 0
    for _ in range(40):
        a, b = draw.uniform((-2, -2, 2), (2, 2, 6), (2, 4, 3))
        try:
            for places in (a, b):
                Scenario((Leg("points", points=tuple(map(tuple, places))),), Fleet(mavs=4))
        except BadExperiment:
            continue
        share = np.linspace(0, 1, 2001)[:, None, None]
        way = (1 - share) * a + share * b
        least = min(np.linalg.norm(way[:, i] - way[:, j], axis=1).min() for i in range(4) for j in range(i))
        path = (Leg("points", points=tuple(map(tuple, a))), Leg("points", points=tuple(map(tuple, b)), move_s=20))
        if least < 0.6:
            found += 1
            with pytest.raises(BadExperiment, match="on the straight way"):
                Scenario(path, Fleet(mavs=4))
        else:
            Scenario(path, Fleet(mavs=4))
    assert 3 < found < 35
