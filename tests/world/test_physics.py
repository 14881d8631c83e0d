"""Do the simulated bodies hover, fall, rest, lag and push as the airframe says?"""

import numpy as np
import pytest

from world.physics import GRAVITY_M_S2, Physics

STEP_S = 0.005


def hovering(mavs: int = 2, height_m: float = 2.0) -> Physics:
    places = [[3.0 * k, 0.0, height_m, 0.5 * k] for k in range(mavs)]
    return Physics(np.array(places), STEP_S)


def steps(physics: Physics, commands: np.ndarray, seconds: float) -> None:
    for _ in range(round(seconds / STEP_S)):
        physics.step(commands)


def hover_thrusts(physics: Physics) -> np.ndarray:
    return np.full((len(physics.state.position), 4), physics.airframe.mass_kg * GRAVITY_M_S2 / 4)


def test_the_airframe_is_the_papers() -> None:
    airframe = hovering().airframe
    assert airframe.mass_kg == 0.5
    assert 4 * airframe.max_thrust_n / (airframe.mass_kg * GRAVITY_M_S2) == pytest.approx(2.2, abs=0.01)
    assert hovering().model.geom("1/hull").size[0] == 0.27


def test_hovers_from_the_first_step() -> None:
    physics = hovering()
    before = physics.state.position.copy()
    steps(physics, hover_thrusts(physics), 2.0)
    np.testing.assert_allclose(physics.state.position, before, atol=1e-9)


def test_falls_and_rests_on_the_ground() -> None:
    physics = hovering()
    steps(physics, np.zeros((2, 4)), 0.4)
    assert physics.state.velocity[0, 2] < -2
    steps(physics, np.zeros((2, 4)), 3.0)
    np.testing.assert_allclose(physics.state.position[:, 2], 0.04, atol=0.005)
    np.testing.assert_allclose(physics.state.velocity, 0, atol=1e-3)


def test_rotors_push_no_more_than_they_can_and_never_pull() -> None:
    physics = hovering()
    steps(physics, np.array([[100.0] * 4, [-100.0] * 4]), 0.5)
    np.testing.assert_allclose(physics.thrusts[0], physics.airframe.max_thrust_n, atol=1e-6)
    np.testing.assert_allclose(physics.thrusts[1], 0, atol=1e-6)
    assert physics.state.velocity[0, 2] < 0.5 * (4 * physics.airframe.max_thrust_n / 0.5 - GRAVITY_M_S2)


def test_rotors_lag_by_their_time_constant() -> None:
    physics = hovering()
    first, last = hover_thrusts(physics)[0, 0], 2.0
    steps(physics, np.full((2, 4), last), 0.03)
    assert (physics.thrusts[0, 0] - first) / (last - first) == pytest.approx(1 - np.exp(-1), abs=1e-6)


def test_the_wrench_is_what_the_bodies_feel() -> None:
    physics, extra = hovering(), np.array([0.3, -0.1, 0.2, 0.05])
    commands = hover_thrusts(physics)
    commands[0] += extra
    physics.thrusts[:] = commands  # past the lag
    physics.step(commands)
    lift_and_torques = physics.airframe.wrench_per_thrust @ extra
    expected = lift_and_torques[1:] / physics.airframe.inertia * STEP_S
    np.testing.assert_allclose(physics.state.rates[0], expected, rtol=1e-3)
    assert physics.state.velocity[0, 2] == pytest.approx(lift_and_torques[0] / 0.5 * STEP_S, rel=1e-3)
    np.testing.assert_allclose(physics.state.rates[1], 0, atol=1e-12)


def test_air_drags() -> None:
    physics = hovering()
    physics.state.velocity[0] = (4.0, 0.0, 0.0)
    steps(physics, hover_thrusts(physics), 0.5)
    assert 3.0 < physics.state.velocity[0, 0] < 3.95


def test_mavs_do_not_pass_through_each_other() -> None:
    physics = Physics(np.array([[0.0, 0.0, 2.0, 0.0], [1.0, 0.0, 2.0, 0.0]]), STEP_S)
    physics.state.velocity[0] = (2.0, 0.0, 0.0)
    for _ in range(80):
        physics.step(hover_thrusts(physics))
        assert np.linalg.norm(physics.state.position[1] - physics.state.position[0]) > 0.5


def test_mavs_that_touch_are_told_and_the_ground_is_not() -> None:
    physics = Physics(np.array([[5.0, 0.0, 0.04, 0.0], [0.0, 0.0, 2.0, 0.0], [0.53, 0.0, 2.0, 0.0]]), STEP_S)
    physics.thrusts[0] = 0.0
    physics.step(np.zeros((3, 4)))
    assert physics.touching() == {(2, 3)}
    physics.state.position[2] = (5.3, 0.0, 0.04)
    physics.step(np.zeros((3, 4)))
    assert physics.touching() == {(1, 3)}
    physics.state.position[2] = (9.0, 0.0, 0.04)
    physics.step(np.zeros((3, 4)))
    assert physics.touching() == set()
