"""Experiment tables: the exact key, the value, and what was expected."""

import pytest

from agent import config
from agent.interface.fleet import Fleet
from agent.interface.tables import BadExperiment, parse_table


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"start": "survey"}, "agent.start: there is no such key"),
        ({"detector": {"P_d": 0.9}}, "agent.detector.P_d: there is no such key"),
        ({"detector": {"P_D": "high"}}, "agent.detector.P_D = 'high': expected float, got str"),
        ({"detector": {"P_D": 1.0}}, "agent.detector.P_D = 1.0: expected a probability"),
        ({"detector": {"false_per_set": 1e-320}}, "false_per_set = 1e-320: expected 1e-06 to 100"),
        ({"detector": {"bearing_sigma_rad": 1e-5}}, "bearing_sigma_rad = 1e-05: expected 0.0001 to 1 rad"),
        ({"detector": {"range_sigma_offset_m": 1e-12}}, "range_sigma_offset_m = 1e-12: expected 0.0001 to 10 m"),
        ({"detector": {"range_sigma_slope": -0.1}}, "range_sigma_slope = -0.1: expected 0 to 1"),
        ({"detector": {"max_range_m": 1e-120}}, "max_range_m = 1e-120: expected 0.1 to 1000 m"),
        ({"detector": {"max_range_m": float("nan")}}, "max_range_m = nan: expected 0.1 to 1000 m"),
        ({"detector": {"fov_azimuth_rad": 7.0}}, "fov_azimuth_rad = 7.0: expected 0.01 to 6.28319 rad"),
        ({"detector": {"fov_elevation_rad": 1e-320}}, "fov_elevation_rad = 1e-320: expected 0.01 to 3.14159 rad"),
        ({"odometry": {"yaw_sigma_rad": 2.0}}, "yaw_sigma_rad = 2.0: expected between 0 and 1 rad"),
        ({"filter": {"P_G": 1.5}}, "P_G = 1.5: expected a probability"),
        ({"filter": {"pruned_mass": 0.5}}, "pruned_mass = 0.5: expected"),
        ({"filter": {"odometry_sigma_m": 1e-200}}, "agent.filter.odometry_sigma_m = 1e-200: expected 1e-06 to 1 m"),
        ({"filter": {"odometry_sigma_rad": 0.0}}, "agent.filter.odometry_sigma_rad = 0.0: expected 1e-06 to 1 rad"),
        ({"mission": {"legs": [], "about": "me"}}, "agent.mission.about = 'me': expected 'centroid' or 'leader'"),
        (
            {"mission": {"legs": [{"formation": "box"}]}},
            "legs[0].formation = 'box': expected 'circle' or 'line' or 'v'",
        ),
        ({"localised_sigma_m": -1.0}, "agent.localised_sigma_m = -1.0: expected between 0 and 100 m"),
        ({"localised_sigma_rad": float("nan")}, "agent.localised_sigma_rad = nan: expected between 0 and 100 rad"),
        ({"lag_s": -0.1}, "agent.lag_s = -0.1: expected 0 to 10 s"),
        ({"wait_for_peers_s": float("inf")}, "agent.wait_for_peers_s = inf: expected between 0 and 100 s"),
    ],
)
def test_agent_table(table, says):
    with pytest.raises(BadExperiment) as caught:
        config.parse(table, Fleet())
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"mavs": 0}, "fleet.mavs = 0: expected 1 to 50"),
        ({"seed": -1}, "seed = -1: expected 0 or more"),
        ({"rate_hz": 0.0}, "rate_hz = 0.0: expected 0.1 to 200 Hz"),
        ({"duration_s": 0.0}, "duration_s = 0.0: expected"),
        ({"mavs": 7.5}, "fleet.mavs = 7.5: expected int, got float"),
    ],
)
def test_fleet_table(table, says):
    with pytest.raises(BadExperiment) as caught:
        parse_table(Fleet, table, "fleet")
    assert says in str(caught.value)


def test_defaults_are_the_papers():
    agent = config.parse({}, Fleet())
    assert (agent.detector.bearing_sigma_rad, agent.detector.range_sigma_slope) == (0.008, 0.0495)
    assert (agent.odometry.position_sigma_m, agent.odometry.yaw_sigma_rad) == (0.01, 0.002)
