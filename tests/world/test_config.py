"""Is the [world] table read, and refused with the key, the value and what was expected?"""

import subprocess
import sys
from typing import Any

import pytest

from agent.interface.fleet import Fleet
from agent.interface.tables import BadExperiment
from world.config import Survey, parse
from world.wind import Wind

CIRCLE: dict[str, Any] = {"formation": "circle", "radius_m": 1.35, "hold_s": 2.0}
PATH: dict[str, Any] = {"path": [CIRCLE]}
FLIGHTS: dict[str, Any] = {"flights": [{"truth": "a", "vio": "b"}] * 7, "flights_dir": "nowhere"}


def test_defaults_are_the_papers() -> None:
    config = parse(PATH, Fleet())
    assert config.survey == "none"
    assert parse(PATH | {"survey": {}}, Fleet()).survey == Survey(position_sigma_m=0.2, yaw_sigma_rad=0.1)
    assert config.odometry.position_sigma_m == 0.01
    assert config.detector.bearing_sigma_rad == 0.008
    assert config.start_yaw == "random"
    assert not config.random_window
    assert not config.commanded
    assert config.wind == Wind((0.0, 0.0, 0.0), 0.0, 1.0)
    assert parse(PATH | {"survey": "none", "start_yaw": "zero"}, Fleet()).survey == "none"
    assert parse({"path": [CIRCLE | {"center": [1, 2, 3]}]}, Fleet()).path[0].center == (1, 2, 3)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, "world: 0 legs of a path and 0 recorded flights, expected one of the two"),
        (PATH | {"flights": [{"truth": "a", "vio": "b"}]}, "1 legs of a path and 1 recorded flights"),
        (PATH | {"rain": 3}, "world.rain: there is no such key"),
        (PATH | {"wind": 3}, "world.wind = 3: expected object, got int"),
        (PATH | {"wind": {"mean_m_s": [1.0, 2.0]}}, "world.wind.mean_m_s: expected array of length 3"),
        (PATH | {"wind": {"mean_m_s": [0.0, 99.0, 0.0]}}, r"world.wind.*mean_m_s = \[0.0, 99.0, 0.0\]: expected three"),
        (PATH | {"wind": {"gust_sigma_m_s": -1.0}}, "world.wind.*gust_sigma_m_s = -1.0: expected 0 to 30 m/s"),
        (PATH | {"wind": {"gust_time_s": 0.0}}, "world.wind.*gust_time_s = 0.0: expected 0.01 to 3600 s"),
        (FLIGHTS | {"wind": {"gust_sigma_m_s": 1.0}}, r"world.wind: expected \[\[world.path\]\], no wind can"),
        (PATH | {"commanded": 1}, "world.commanded = 1: expected bool, got int"),
        (FLIGHTS | {"commanded": True}, "world.commanded = true: recorded flights, expected one leg"),
        (
            {"path": [CIRCLE, CIRCLE | {"move_s": 2.0}], "commanded": True},
            "world.commanded = true: 2 legs of a path, expected one leg: where the MAVs start",
        ),
        (
            {"path": [CIRCLE | {"radius_m": 0.5, "height_step_m": 1.0}], "commanded": True},
            r"world.path\[0\]: when there MAVs . and . are 0.43 m apart, expected at least 0.6 m",
        ),
        (
            {"path": [{"formation": "box", "size_m": [2.0, 2.0, 50.0]}], "commanded": True},
            r"world.path\[0\].size_m = \[2.0, 2.0, 50.0\]: 7 MAVs are never all 1 m apart",
        ),
        ({"path": [CIRCLE | {"speed": 3}]}, r"world.path\[0\].speed: there is no such key"),
        (
            {"path": [{"formation": "ring"}]},
            r"world.path\[0\].formation = 'ring': expected 'circle' or 'line' or 'v' or 'grid'",
        ),
        ({"path": [{"radius_m": 1.0}]}, r"world.path\[0\].formation: this key is required"),
        ({"path": [CIRCLE | {"hold_s": "long"}]}, r"world.path\[0\].hold_s = 'long': expected float, got str"),
        ({"path": [CIRCLE, CIRCLE | {"radius_m": 0.1, "move_s": 5.0}]}, r"world.path\[1\]: when there MAVs"),
        (PATH | {"detector": {"P_D": 2.0}}, "world.detector.* = 2.0: expected a probability"),
        (PATH | {"survey": {"yaw_sigma_rad": 0.0}}, "world.survey.*yaw_sigma_rad = 0.0: expected 1e-06 to 100"),
        (PATH | {"start_yaw": "north"}, "world.start_yaw = 'north': expected 'random' or 'zero'$"),
        (PATH | {"survey": "non"}, "world.survey = 'non': expected a table or 'none'$"),
        ({"flights": [{"truth": "a"}]}, r"world.flights\[0\].vio: this key is required"),
        ({"flights": [{"truth": "a", "vio": "b"}]}, "world.flights: 1 flights, expected 7"),
        ({"flights": [{"truth": "a", "vio": "b"}] * 7}, "world.flights_dir: where are the recorded flights"),
        (PATH | {"random_window": True}, r"world.random_window = true: expected \[\[world.flights\]\]"),
        (PATH | {"random_window": "yes"}, "world.random_window = 'yes': expected bool, got str"),
        (
            {"flights": [{"truth": "a", "vio": "b"}] * 7, "flights_dir": "nowhere"},
            r"world.flights\[0\]: cannot read nowhere/a: No such file",
        ),
    ],
)
def test_errors(table: dict[str, Any], words: str) -> None:
    with pytest.raises(BadExperiment, match=words):
        parse(table, Fleet())


def test_a_run_of_no_tick() -> None:
    with pytest.raises(BadExperiment, match=r"fleet.duration_s = 0.04: shorter than one tick at 10 Hz"):
        parse(PATH, Fleet(duration_s=0.04))


def test_reading_the_table_needs_no_simulator() -> None:
    code = "import sys, world.config; sys.exit(any(name in sys.modules for name in ('mujoco', 'scipy')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
