"""Missions that cannot be flown are refused with exact words; and where the places of a formation are."""

import numpy as np
import pytest

from agent.config import parse
from agent.interface.fleet import Fleet
from agent.interface.mission import Leg, places
from agent.interface.tables import BadExperiment

LINE = {"formation": "line", "length_m": 6.0}


def test_places_are_turned_about_the_center():
    turned = places(Leg("line", length_m=4.0, center=(1.0, 2.0, 3.0), heading_rad=np.pi / 2), 3)
    np.testing.assert_allclose(turned, [[-1, 2, 3], [1, 2, 3], [3, 2, 3]], atol=1e-9)
    points = ((0.0, 0.0, 0.0), (2.0, 0.0, 1.0))
    np.testing.assert_allclose(places(Leg("points", points=points), 2), np.add(points, (0, 0, 1.5)))


def test_a_mission_that_can_be_flown_is_taken():
    table = {"mission": {"legs": [LINE, {"formation": "grid", "spacing_m": 1.0}], "leader": 2, "about": "leader"}}
    mission = parse(table, Fleet(mavs=5)).mission
    assert mission is not None
    assert [leg.formation for leg in mission.legs] == ["line", "grid"]
    assert parse({}, Fleet(mavs=5)).mission is None


@pytest.mark.parametrize(
    ("mission", "says"),
    [
        ({"legs": []}, "agent.mission.legs: none, expected one or more"),
        ({"legs": [LINE], "leader": 8}, "agent.mission.leader = 8: expected a MAV, 1 to 7"),
        ({"legs": [LINE], "leader": 0}, "agent.mission.leader = 0: expected a MAV, 1 to 7"),
        ({"legs": [{"formation": "line"}]}, "agent.mission.legs[0]: formation 'line' needs length_m"),
        ({"legs": [LINE | {"radius_m": 1.0}]}, "legs[0]: formation 'line' does not take radius_m"),
        ({"legs": [LINE, LINE | {"length_m": 5.0}]}, "legs[1]: places 0.83 m apart, expected at least 0.92 m"),
        ({"legs": [LINE | {"length_m": -1.0}]}, "legs[0].length_m = -1: expected between 0 and 1000 m"),
        ({"legs": [LINE | {"center": [0, 0, 0.2]}]}, "legs[0]: a place at 0.20 m, expected at least 0.5 m"),
        ({"legs": [LINE | {"center": [0, 0, float("inf")]}]}, "must be finite and within 10 km"),
        ({"legs": [LINE | {"hold_s": -1.0}]}, "legs[0].hold_s = -1: expected 0 to 86400 s"),
        ({"legs": [{"formation": "points", "points": [[0, 0, 0]]}]}, "points: 1 points, expected 7, one per MAV"),
        ({"legs": [LINE], "speed_m_s": 9.0}, "speed_m_s = 9: expected 0.05 to 5 m/s"),
        ({"legs": [LINE], "take_off_m": 0.1}, "take_off_m = 0.1: expected 0.5 to 100 m"),
        ({"legs": [LINE], "replan_beyond_m": 0.0}, "replan_beyond_m = 0: expected 0.001 to inf m"),
        ({"legs": [LINE], "altitude": 1.0}, "altitude"),
    ],
)
def test_a_mission_that_cannot_is_refused(mission, says):
    with pytest.raises(BadExperiment) as error:
        parse({"mission": mission}, Fleet(mavs=7))
    assert says in str(error.value)
