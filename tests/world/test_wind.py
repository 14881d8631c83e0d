"""Does the wind push, blow as it is said to, and the same for the same seed?"""

import numpy as np
import pytest

from agent.interface.fleet import Fleet
from world.config import parse
from world.physics import GRAVITY_M_S2, Physics
from world.simulated import SimulatedFlight
from world.wind import Gusts, Wind

STEP_S = 0.005
TABLE = {"path": [{"formation": "circle", "radius_m": 2.0}]}


def flown(seed: int, seconds: float = 2.0, **wind: object) -> SimulatedFlight:
    fleet = Fleet(mavs=3, seed=seed)
    motion = SimulatedFlight(parse(TABLE | ({"wind": wind} if wind else {}), fleet), fleet)
    for _ in range(round(10 * seconds)):
        motion.step()
    return motion


def blown(gusts: Gusts, steps: int) -> np.ndarray:
    return np.array([gusts.step() for _ in range(steps)])


def test_five_metres_a_second_push_a_hovering_mav_with_some_tenths_of_a_newton() -> None:
    physics = Physics(np.array([[0.0, 0.0, 2.0, 0.7]]), STEP_S)
    physics.blow(np.array([3.0, -4.0, 0.0]))
    physics.step(np.full((1, 4), physics.airframe.mass_kg * GRAVITY_M_S2 / 4))
    force = physics.airframe.mass_kg * physics.state.velocity[0] / STEP_S
    np.testing.assert_allclose(force, 0.44 * np.array([0.6, -0.8, 0.0]), atol=0.1)
    assert np.linalg.norm(force) == pytest.approx(0.4, abs=0.1)


def test_a_steady_wind_moves_all_mavs_alike_and_the_autopilot_leans_against_it() -> None:
    motion = flown(0, 4.0, mean_m_s=[5.0, 0.0, 0.0])
    off = motion.true.position - motion._scenario.start
    assert ((off[:, 0] > 0.05) & (off[:, 0] < 0.15)).all()
    assert np.abs(off[:, 1:]).max() < 0.03
    np.testing.assert_allclose(motion._physics.state.velocity, 0, atol=0.02)


def test_gusts_have_their_mean_spread_and_time() -> None:
    wind = Wind(mean_m_s=(3.0, -2.0, 0.0), gust_sigma_m_s=1.5, gust_time_s=0.5)
    blew = blown(Gusts(wind, 1, STEP_S), 200_000)  # 2000 times its time
    np.testing.assert_allclose(blew.mean(axis=0), wind.mean_m_s, atol=4 * 1.5 * np.sqrt(2 / 2000))
    np.testing.assert_allclose(blew.std(axis=0), 1.5, rtol=0.1)
    gust = blew - blew.mean(axis=0)
    later = (gust[:-100] * gust[100:]).mean(axis=0) / gust.var(axis=0)
    np.testing.assert_allclose(later, np.exp(-1), atol=0.1)
    np.testing.assert_allclose(np.corrcoef(gust.T) - np.eye(3), 0, atol=0.15)
    first = np.array([Gusts(wind, seed, STEP_S).step() for seed in range(500)])  # it blows from the start
    np.testing.assert_allclose(first.std(axis=0), 1.5, rtol=0.15)


def test_its_statistics_do_not_depend_on_the_step() -> None:
    wind = Wind(gust_sigma_m_s=1.0, gust_time_s=0.1)
    assert blown(Gusts(wind, 1, 1.0), 2000).std() == pytest.approx(1.0, rel=0.1)


def test_the_same_seed_blows_the_same_bits_and_another_does_not() -> None:
    gusty = {"gust_sigma_m_s": 2.0}
    one, two, other = flown(5, **gusty), flown(5, **gusty), flown(6, **gusty)
    assert one.true.position.tobytes() == two.true.position.tobytes()
    assert np.abs(one.true.position - other.true.position).max() > 1e-3


def test_no_wind_is_as_if_there_were_none() -> None:
    calm = flown(5, mean_m_s=[0.0, 0.0, 0.0], gust_time_s=2.0)
    assert calm.true.position.tobytes() == flown(5).true.position.tobytes()
