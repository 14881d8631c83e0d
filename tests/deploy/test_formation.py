"""How near is a team to its formation, wherever that lies?"""

import numpy as np
import pytest

from agent.interface.frames import rotate_z
from agent.interface.intent import FORMING, HOLDING, LOST
from agent.interface.mission import Leg, Mission, places
from deploy import formation
from deploy.recording import Intents

MISSION = Mission((Leg("line", length_m=3.0), Leg("circle", radius_m=1.2)))


@pytest.mark.parametrize("seed", range(5))
def test_where_it_lies_and_how_it_is_turned_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    goals = rng.normal(size=(5, 3))
    there = rotate_z(rng.uniform(-3, 3), goals) + rng.normal(size=3)
    exact = formation.fitted(there, goals)
    assert exact.rms_m == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(exact.goals, there, atol=1e-9)
    off = rng.normal(0, 0.1, (5, 3))
    off -= off.mean(0)
    assert 0 < formation.fitted(there + off, goals).rms_m <= np.sqrt((off**2).sum(1).mean()) + 1e-9


def test_a_tilt_is_an_error():
    goals = places(MISSION.legs[0], 3)
    tilted = goals + np.array([[0, 0, 0.3], [0, 0, 0], [0, 0, -0.3]])
    assert formation.fitted(tilted, goals).rms_m == pytest.approx(0.3 * np.sqrt(2 / 3))


def test_only_those_count_who_fly_one_formation():
    goals = places(MISSION.legs[1], 4)[[2, 0, 1, 3]]
    positions = np.stack([goals] * 4)
    positions[:, 3] += 9  # far away, and lost
    phase = np.array([[HOLDING, FORMING, HOLDING, LOST]] * 4)
    which, place = np.ones((4, 4), int), np.array([[2, 0, 1, 3]] * 4)
    which[1, 0], phase[2] = 0, -1
    found = formation.shapes(positions, Intents(phase, which, place), MISSION)
    assert [shape is None for shape in found] == [False, True, True, False]
    assert found[0].rms_m == pytest.approx(0, abs=1e-9)


def test_the_last_seconds_are_judged_if_a_formation_is_held_in_all_of_them():
    near, far = formation.Shape(np.zeros((1, 3)), 0.1), formation.Shape(np.zeros((1, 3)), 7.0)
    assert formation.last_rms_m([far] * 9 + [near] * 10, rate_hz=2.0) == pytest.approx(0.1)
    assert np.isnan(formation.last_rms_m([far] * 9 + [near] * 9 + [None], rate_hz=2.0))


def test_a_leg_is_reached_when_all_are_in_formation_and_until_one_leaves():
    line, circle = (places(leg, 3) for leg in MISSION.legs)
    positions = np.stack([line] * 4 + [circle] * 2)
    positions[2, 1, 2] += 0.3
    phase = np.array(
        [[FORMING] * 3, [HOLDING, HOLDING, FORMING], [HOLDING] * 3, [HOLDING] * 3, [FORMING] * 3, [FORMING] * 3]
    )
    which, place = np.array([[0] * 3] * 4 + [[1] * 3] * 2), np.array([[0, 1, 2]] * 6)
    intents = Intents(phase, which, place)
    found = formation.shapes(positions, intents, MISSION)
    first, second = formation.reached(found, intents, MISSION, np.arange(6) / 2)
    assert (first.formation, first.at_s) == ("line", 1.0)
    assert first.rms_m == pytest.approx(0.1)  # one of three, in one of two ticks: sqrt(0.3^2 * 2 / 9 / 2)
    assert second.formation == "circle"
    assert np.isnan([second.at_s, second.rms_m]).all()
