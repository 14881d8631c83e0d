"""Where are the MAVs when physics and autopilots fly the scripted path, and what does their odometry read?"""

import math
from collections.abc import Iterable

import numpy as np

from agent.interface import messages
from agent.interface.fleet import Fleet
from agent.interface.frames import Array
from agent.interface.seeds import generator
from world.autopilot import AIM_PERIOD_S, Autopilot
from world.config import WorldConfig
from world.physics import Physics
from world.poses import Poses
from world.scenario import Scenario, Setpoints
from world.vio import Vio
from world.wind import Gusts, Wind

MAX_STEP_S = 0.005  # of physics and autopilot


class SimulatedFlight:
    """A source of motion: `true` and `vio` are the poses of this tick, `step` goes on to the next."""

    def __init__(self, config: WorldConfig, fleet: Fleet) -> None:
        self._scenario = Scenario(config.path, fleet, config.commanded)
        random_yaw = generator(fleet.seed, "start_yaw").uniform(-np.pi, np.pi, fleet.mavs)
        self._yaw = random_yaw if config.start_yaw == "random" else np.zeros(fleet.mavs)
        self._steps_per_tick = math.ceil(1 / (fleet.rate_hz * MAX_STEP_S) - 1e-9)
        self._step_s = 1 / (fleet.rate_hz * self._steps_per_tick)
        self._steps = 0
        self._physics = Physics(np.column_stack([self._scenario.start, self._yaw]), self._step_s)
        self._autopilot = Autopilot(self._physics.airframe, fleet.mavs)
        self._steps_per_aim = math.floor(AIM_PERIOD_S / self._step_s + 1e-9)
        self._gusts = None if config.wind == Wind() else Gusts(config.wind, fleet.seed, self._step_s)
        self.contacts: set[tuple[int, int]] = set()
        self.true = self._poses()
        self._vio = Vio(config.odometry, fleet, self.true)
        self.pose_world_odom = self._vio.pose_world_odom

    @property
    def vio(self) -> Poses:
        """In each MAV's odometry frame."""
        return self._vio.poses

    def begin_odometry(self, mav: int) -> None:
        self._vio.begin(mav - 1)

    def command(self, setpoints: Iterable[messages.Setpoint]) -> None:
        """They fly the path, whatever is commanded."""

    def step(self) -> None:
        self.contacts = set()
        for _ in range(self._steps_per_tick):
            if self._steps % self._steps_per_aim == 0:
                self._autopilot.aim(self._physics.state, self._wanted(self._steps * self._step_s))
            if self._gusts is not None:
                self._physics.blow(self._gusts.step())
            self._physics.step(self._thrusts())
            self.contacts |= self._physics.touching()
            self._steps += 1
        self.true = self._poses()
        self._vio.advance(self.true)

    def _wanted(self, time_s: float) -> Setpoints:
        return self._scenario.setpoints(time_s, self._yaw)

    def _thrusts(self) -> Array:
        """(N, 4) N, asked of the rotors."""
        return self._autopilot.commands(self._physics.state)

    def _poses(self) -> Poses:
        state = self._physics.state
        return Poses(state.position.copy(), state.quaternion_wxyz[:, [1, 2, 3, 0]])
