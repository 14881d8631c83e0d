"""How do the MAVs move when their rotors push? Rigid bodies, rotor lag, air and ground, in MuJoCo."""

from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from agent.interface.frames import Array

GRAVITY_M_S2 = 9.81
AIR_DENSITY = 1.2  # kg/m^3: MuJoCo's drag of a body's equivalent inertia box
AIR_VISCOSITY = 1.8e-5  # Pa s
ROTORS = 4
GROUND = 0  # its geom; that of MAV k is k
TEMPLATE = Path(__file__).with_name("mav.xml")


class State(NamedTuple):
    """Where the MAVs truly are. Views: they change when the physics steps."""

    position: Array  # (N, 3) m, world
    quaternion_wxyz: Array  # (N, 4) body in world; MuJoCo's order
    velocity: Array  # (N, 3) m/s, world
    rates: Array  # (N, 3) rad/s, body


class Airframe(NamedTuple):
    """What an autopilot must know of the MAV it flies; all MAVs are alike."""

    mass_kg: float
    inertia: Array  # (3,) kg m^2, about the body's axes
    wrench_per_thrust: Array  # (4, 4): [lift N, torque x y z N m] from the rotors' thrusts, N
    max_thrust_n: float  # of one rotor


class Physics:
    """N MAVs over flat ground at z = 0; at first they hover."""

    def __init__(self, poses: Array, step_s: float) -> None:
        """poses (N, 4): x y z m, yaw rad in the world; step_s at most 0.005 for the autopilot's sake."""
        mavs = len(poses)
        self.model = _scene(mavs, step_s)
        self._data = mujoco.MjData(self.model)
        qpos, qvel = self._data.qpos.reshape(mavs, 7), self._data.qvel.reshape(mavs, 6)
        qpos[:, :3] = poses[:, :3]
        qpos[:, 3], qpos[:, 6] = np.cos(poses[:, 3] / 2), np.sin(poses[:, 3] / 2)
        self.state = State(qpos[:, :3], qpos[:, 3:], qvel[:, :3], qvel[:, 3:])
        self.airframe = _airframe(self.model)
        self.thrusts = self._data.act.reshape(mavs, ROTORS)  # (N, 4) N: what the rotors push, after their lag
        self._commands = self._data.ctrl.reshape(mavs, ROTORS)
        self.thrusts[:] = self._commands[:] = self.airframe.mass_kg * GRAVITY_M_S2 / ROTORS

    def step(self, commands: Array) -> None:
        """One time step with these thrusts (N, 4) asked of the rotors, N; each is held within what a rotor can do."""
        self._commands[:] = commands
        mujoco.mj_step(self.model, self._data)

    def touching(self) -> set[tuple[int, int]]:
        """Pairs of MAV numbers, ascending, that were in contact when the last step began."""
        if not self._data.ncon:
            return set()
        return {(min(a, b), max(a, b)) for a, b in self._data.contact.geom.tolist() if a != GROUND != b}

    def blow(self, wind: Array) -> None:
        """From the next step on the air moves with this velocity (3,) m/s, world."""
        self.model.opt.wind[:] = wind


def _scene(mavs: int, step_s: float) -> mujoco.MjModel:
    scene = mujoco.MjSpec()
    scene.option.timestep = step_s
    scene.option.gravity = [0, 0, -GRAVITY_M_S2]
    scene.option.density, scene.option.viscosity = AIR_DENSITY, AIR_VISCOSITY
    scene.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[100, 100, 1])
    for mav in range(1, mavs + 1):
        template = mujoco.MjSpec.from_file(str(TEMPLATE))
        scene.worldbody.add_frame().attach_body(template.body("mav"), f"{mav}/", "")
    return scene.compile()


def _airframe(model: mujoco.MjModel) -> Airframe:
    """Read from the compiled model, so that mav.xml stays the only place where it is written."""
    arms, gears = model.site_pos[:ROTORS], model.actuator_gear[:ROTORS]
    x, y = arms[:, 0], arms[:, 1]
    wrench = np.stack([np.ones(ROTORS), y, -x, gears[:, 5]])
    body = model.body("1/mav").id
    return Airframe(
        mass_kg=float(model.body_mass[body]),
        inertia=np.array(model.body_inertia[body]),
        wrench_per_thrust=wrench,
        max_thrust_n=float(model.actuator_ctrlrange[0, 1]),
    )
