"""Does the autopilot follow setpoints, within what the rotors can do?"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agent.interface.fleet import Fleet
from agent.interface.frames import wrap, yaw_of
from world.autopilot import Autopilot
from world.physics import GRAVITY_M_S2, Physics, State
from world.scenario import Leg, Scenario, Setpoints

STEP_S = 0.005
STEPS_PER_AIM = 4


def fly(physics: Physics, setpoints: Setpoints, seconds: float) -> None:
    pilot = Autopilot(physics.airframe, len(physics.state.position))
    for k in range(round(seconds / STEP_S)):
        if k % STEPS_PER_AIM == 0:
            pilot.aim(physics.state, setpoints)
        physics.step(pilot.commands(physics.state))


def attitudes(draw: np.random.Generator, count: int) -> np.ndarray:
    quaternion = draw.standard_normal((count, 4))
    return np.asarray(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))


def standing(position: list[float], yaw: float) -> Setpoints:
    return Setpoints(np.array([position]), np.zeros((1, 3)), np.zeros((1, 3)), np.array([yaw]))


def true_yaw(physics: Physics) -> np.ndarray:
    return yaw_of(physics.state.quaternion_wxyz[:, [1, 2, 3, 0]])


def test_commands_are_those_of_the_attitude_error_and_the_rates() -> None:
    """The plain twin: from the definitions, for one MAV at a time, while thrust and wanted attitude are held."""
    draw = np.random.default_rng(1)
    airframe = Physics(np.zeros((1, 4)), STEP_S).airframe._replace(mass_kg=5.0, max_thrust_n=100.0)  # so none saturates
    yaw, tilt = draw.uniform(-3, 3, 9), draw.normal(0, 0.2, (9, 2))
    aimed, later = (
        State(
            draw.normal((0, 0, 2), 0.1, (9, 3)),
            Rotation.from_euler("ZYX", np.column_stack([yaw + turned, tilt + turned])).as_quat(scalar_first=True),
            *draw.normal(0, 0.1, (2, 9, 3)),
        )
        for turned in (0.0, 0.1)
    )
    wanted = Setpoints(draw.normal((0, 0, 2), 0.1, (9, 3)), *draw.normal(0, 0.1, (2, 9, 3)), draw.uniform(-9, 9, 9))
    pilot = Autopilot(airframe, 9)
    pilot.aim(aimed, wanted)
    for state in (aimed, later):
        for k, commands in enumerate(pilot.commands(state)):
            body = Rotation.from_quat(aimed.quaternion_wxyz[k], scalar_first=True)
            push = 9 * (wanted.position - aimed.position)[k] + 5 * (wanted.velocity - aimed.velocity)[k]
            push += wanted.acceleration[k] + (0, 0, GRAVITY_M_S2)
            up = body.apply((0, 0, 1))
            axis = np.cross(up, push) / np.linalg.norm(np.cross(up, push))
            tilt = Rotation.from_rotvec(axis * np.arccos(up @ push / np.linalg.norm(push)))
            yaw_error = np.clip(wrap(wanted.yaw[k] - np.arctan2(*body.as_matrix()[[1, 0], 0])), -0.3, 0.3)
            wanted_body = tilt * body * Rotation.from_rotvec((0, 0, yaw_error))
            now = Rotation.from_quat(state.quaternion_wxyz[k], scalar_first=True)
            turn = (now.inv() * wanted_body).as_rotvec()
            error = 2 * np.sin(np.linalg.norm(turn) / 2) * turn / np.linalg.norm(turn)
            wrench = np.append(airframe.mass_kg * push @ up, airframe.inertia * (240 * error - 26 * state.rates[k]))
            asked = np.linalg.solve(airframe.wrench_per_thrust, wrench)
            assert 0 < asked.min() < asked.max() < airframe.max_thrust_n
            np.testing.assert_allclose(commands, asked, atol=1e-9)


@pytest.mark.parametrize(
    ("path", "limit_m"),
    [
        ((Leg("circle", radius_m=1.35, hold_s=1), Leg("circle", radius_m=2.7, move_s=4)), 0.02),
        ((Leg("circle", radius_m=1.35), Leg("line", length_m=12.0, move_s=6)), 0.02),
        # Far and fast the air drags, which is not anticipated.
        ((Leg("circle", radius_m=1.35), Leg("circle", radius_m=1.35, center=(20, 0, 1.5), move_s=14)), 0.04),
        # Close to what is allowed: 4.9 m/s and 4.6 m/s^2.
        ((Leg("line", length_m=6.0), Leg("line", length_m=6.0, center=(8, 0, 1.5), move_s=3.6)), 0.1),
    ],
)
def test_follows_a_leg(path: tuple[Leg, ...], limit_m: float) -> None:
    scenario, yaw = Scenario(path, Fleet()), np.linspace(-3, 3, 7)
    physics = Physics(np.column_stack([scenario.start, yaw]), STEP_S)
    pilot, worst_m = Autopilot(physics.airframe, 7), 0.0
    seconds = sum(leg.move_s + leg.hold_s for leg in path) + 2.5
    for k in range(round(seconds / STEP_S)):
        wanted = scenario.setpoints(k * STEP_S, yaw)
        worst_m = max(worst_m, np.linalg.norm(wanted.position - physics.state.position, axis=1).max())
        if k % STEPS_PER_AIM == 0:
            pilot.aim(physics.state, wanted)
        physics.step(pilot.commands(physics.state))
    assert worst_m < limit_m
    np.testing.assert_allclose(physics.state.position, scenario.setpoints(seconds, yaw).position, atol=0.002)
    np.testing.assert_allclose(wrap(true_yaw(physics) - yaw), 0, atol=0.002)


def test_reaches_a_far_setpoint_and_yaw_from_a_bad_attitude() -> None:
    physics = Physics(np.array([[0.0, 0.0, 3.0, 0.0]]), STEP_S)
    physics.state.quaternion_wxyz[0] = (np.cos(0.6), np.sin(0.6), 0, 0)  # rolled by 1.2 rad
    fly(physics, standing([2.0, -1.0, 2.0], 3.0), 6.0)
    np.testing.assert_allclose(physics.state.position, [[2.0, -1.0, 2.0]], atol=0.01)
    np.testing.assert_allclose(wrap(true_yaw(physics) - 3.0), 0, atol=0.01)


def test_turns_the_short_way() -> None:
    physics = Physics(np.array([[0.0, 0.0, 2.0, 3.0]]), STEP_S)
    fly(physics, standing([0.0, 0.0, 2.0], -3.0), 0.2)
    assert physics.state.rates[0, 2] > 0.1


def test_commands_stay_within_limits_in_any_state() -> None:
    airframe, draw = Physics(np.zeros((1, 4)), STEP_S).airframe, np.random.default_rng(2)
    quaternion = attitudes(draw, 500)
    quaternion[0] = (0, 1, 0, 0)  # upside down
    vectors = [10 * draw.standard_normal((500, 3)) for _ in range(6)]
    state = State(vectors[0], quaternion, vectors[1], vectors[2])
    wanted = Setpoints(vectors[3], vectors[4], vectors[5], draw.uniform(-9, 9, 500))
    pilot = Autopilot(airframe, 500)
    pilot.aim(state, wanted)
    commands = pilot.commands(state)
    assert np.isfinite(commands).all()
    assert commands.min() >= 0
    assert commands.max() <= airframe.max_thrust_n
