"""Do the bundled experiments start as they say: nobody is told anything, and the places are as described?"""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.interface.fleet import Fleet
from agent.interface.tables import parse_table
from world.config import WorldConfig, parse
from world.scenario import Scenario

FOLDER = Path(__file__).parents[2] / "deploy" / "experiments"
SIMULATED = ("cold_start", "cold_start_line", "cold_start_circle", "cold_start_symmetric")
TAKING_OFF = ("paper_run_1", "paper_run_1_far", "line")


def read(name: str) -> dict[str, Any]:
    return tomllib.loads((FOLDER / f"{name}.toml").read_text())


def scenario(name: str, seed: int = 0) -> Scenario:
    tables = read(name)
    fleet = Fleet(**tables["fleet"], seed=seed)
    return Scenario(parse(tables["world"], fleet).path, fleet)


def at(flown: Scenario, time_s: float) -> np.ndarray:
    return flown.setpoints(time_s, np.zeros(7)).position


@pytest.mark.parametrize("name", SIMULATED + TAKING_OFF)
def test_they_can_be_flown_with_any_seed_and_last_as_long_as_they_say(name: str) -> None:
    tables = read(name)
    for seed in range(50):
        config = parse(tables["world"], Fleet(**tables["fleet"], seed=seed))
    assert config.survey == "none"
    assert sum(leg.move_s + leg.hold_s for leg in config.path) == tables["fleet"]["duration_s"]
    assert f"({tables['fleet']['duration_s']:g} s at 10 Hz)" in (FOLDER / f"{name}.toml").read_text().splitlines()[0]


def test_a_random_box() -> None:
    one, two = scenario("cold_start", 1).start, scenario("cold_start", 2).start
    assert (np.abs(one - [0, 0, 1.5]) <= [4, 4, 0.75]).all()
    assert np.abs(one - two).max() > 1


def test_a_line_that_is_not_quite_straight() -> None:
    off = scenario("cold_start_line").start - [[0, 3 - k, 1.5] for k in range(7)]
    assert 0.05 < off.std() < 0.2


def test_a_circle_that_takes_off_to_different_heights() -> None:
    flown = scenario("cold_start_circle")
    np.testing.assert_allclose(flown.start[:, 2], 0.5)
    np.testing.assert_allclose(at(flown, 1.0), flown.start)
    np.testing.assert_allclose(at(flown, 2.5) - flown.start, [[0, 0, 0.24 * k] for k in range(7)], atol=1e-12)


@pytest.mark.parametrize("name", TAKING_OFF)
def test_a_take_off_to_different_heights_and_back_to_one(name: str) -> None:
    flown = scenario(name)
    np.testing.assert_allclose(at(flown, 1.0) - flown.start, 0)
    np.testing.assert_allclose(at(flown, 3.0) - flown.start, [[0, 0, 1 + 0.15 * k] for k in range(7)], atol=1e-12)
    np.testing.assert_allclose(at(flown, 6.0) - flown.start, [[0, 0, 1]] * 7, atol=1e-12)


def test_a_circle_that_looks_the_same_to_all_at_all_times() -> None:
    flown = scenario("cold_start_symmetric")
    for time_s in np.linspace(0, 30, 61):
        p = at(flown, time_s)
        distances = np.sort(np.linalg.norm(p[:, None] - p[None], axis=-1), axis=1)
        np.testing.assert_allclose(distances, distances[[0] * 7], atol=1e-9)
    radii = [np.linalg.norm(at(flown, time_s)[0, :2]) for time_s in (0, 9, 16, 23, 30)]
    np.testing.assert_allclose(radii, [1.35, 2.7, 1.35, 2.7, 1.35])


def test_recorded_flights_are_those_of_the_other_experiment() -> None:
    cold, warm = read("cold_start_recorded"), read("recorded_flights")
    assert cold["agent"] == warm["agent"]
    assert cold["world"] == {"random_window": True} | warm["world"]
    config = parse_table(WorldConfig, cold["world"], "world")
    assert (config.random_window, config.survey) == (True, "none")
    assert cold["fleet"] == warm["fleet"] | {"duration_s": 20.0}
