"""Does the autopilot follow setpoints, within what the rotors can do?"""

import numpy as np
import pytest

from agent.interface.fleet import Fleet
from agent.interface.frames import rotation_matrix, wrap, yaw_of
from world import autopilot
from world.autopilot import Autopilot
from world.physics import Physics, State
from world.scenario import Leg, Scenario, Setpoints

STEP_S = 0.005


def fly(physics: Physics, setpoints: Setpoints, seconds: float) -> None:
    pilot = Autopilot(physics.airframe)
    for _ in range(round(seconds / STEP_S)):
        physics.step(pilot.commands(physics.state, setpoints))


def standing(position: list[float], yaw: float) -> Setpoints:
    return Setpoints(np.array([position]), np.zeros((1, 3)), np.zeros((1, 3)), np.array([yaw]))


def true_yaw(physics: Physics) -> np.ndarray:
    return yaw_of(physics.state.quaternion_wxyz[:, [1, 2, 3, 0]])


def test_rotation_matrices_equal_their_plain_twin() -> None:
    quaternion = np.random.default_rng(1).standard_normal((9, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    plain = rotation_matrix(quaternion[:, [1, 2, 3, 0]])
    np.testing.assert_allclose(autopilot._rotations(quaternion), plain, atol=1e-14)


@pytest.mark.parametrize(
    ("path", "limit_m"),
    [
        ((Leg("circle", radius_m=1.35, hold_s=1), Leg("circle", radius_m=2.7, move_s=4, hold_s=1)), 0.02),
        ((Leg("circle", radius_m=1.35), Leg("line", length_m=12.0, move_s=6, hold_s=1)), 0.02),
        # Close to what is allowed: 4.9 m/s and 4.6 m/s^2.
        ((Leg("line", length_m=6.0), Leg("line", length_m=6.0, center=(8, 0, 1.5), move_s=3.6)), 0.1),
    ],
)
def test_follows_a_leg(path: tuple[Leg, ...], limit_m: float) -> None:
    scenario, yaw = Scenario(path, Fleet()), np.linspace(-3, 3, 7)
    physics = Physics(np.column_stack([scenario.start, yaw]), STEP_S)
    pilot, worst_m = Autopilot(physics.airframe), 0.0
    for k in range(round(7 / STEP_S)):
        wanted = scenario.setpoints(k * STEP_S, yaw)
        worst_m = max(worst_m, np.linalg.norm(wanted.position - physics.state.position, axis=1).max())
        physics.step(pilot.commands(physics.state, wanted))
    assert worst_m < limit_m
    np.testing.assert_allclose(physics.state.position, scenario.setpoints(7, yaw).position, atol=0.02)
    np.testing.assert_allclose(wrap(true_yaw(physics) - yaw), 0, atol=0.02)


def test_reaches_a_far_setpoint_and_yaw_from_a_bad_attitude() -> None:
    physics = Physics(np.array([[0.0, 0.0, 3.0, 0.0]]), STEP_S)
    physics.state.quaternion_wxyz[0] = (np.cos(0.6), np.sin(0.6), 0, 0)  # rolled by 1.2 rad
    fly(physics, standing([2.0, -1.0, 2.0], 3.0), 6.0)
    np.testing.assert_allclose(physics.state.position, [[2.0, -1.0, 2.0]], atol=0.01)
    np.testing.assert_allclose(wrap(true_yaw(physics) - 3.0), 0, atol=0.01)


def test_turns_the_short_way() -> None:
    physics = Physics(np.array([[0.0, 0.0, 2.0, 3.0]]), STEP_S)
    pilot = Autopilot(physics.airframe)
    for _ in range(40):
        physics.step(pilot.commands(physics.state, standing([0.0, 0.0, 2.0], -3.0)))
    assert physics.state.rates[0, 2] > 0.1


def test_commands_stay_within_limits_in_any_state() -> None:
    airframe, draw = Physics(np.zeros((1, 4)), STEP_S).airframe, np.random.default_rng(2)
    quaternion = draw.standard_normal((500, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    quaternion[0] = (0, 1, 0, 0)  # upside down
    vectors = [10 * draw.standard_normal((500, 3)) for _ in range(6)]
    state = State(vectors[0], quaternion, vectors[1], vectors[2])
    wanted = Setpoints(vectors[3], vectors[4], vectors[5], draw.uniform(-9, 9, 500))
    commands = Autopilot(airframe).commands(state, wanted)
    assert np.isfinite(commands).all()
    assert commands.min() >= 0
    assert commands.max() <= airframe.max_thrust_n
