"""Where are the MAVs when they fly what their agents command, by their own odometry?

A setpoint is in the MAV's odometry frame. Where that frame is now is what the MAV's VIO says: the true pose less the
reading. So the drift of its VIO moves a MAV, as it does a real one. From its stamp on a setpoint moves by its velocity
and acceleration; if no other has come after EXTRAPOLATED_S, it stays where it then is, at rest: so does the MAV of an
agent that is gone.
"""

from collections.abc import Iterable

import numpy as np

from agent.interface import messages
from agent.interface.fleet import Fleet
from agent.interface.frames import Array, compose, inverse, rotate_z
from world.autopilot import Autopilot
from world.config import WorldConfig
from world.scenario import Setpoints
from world.simulated import SimulatedFlight

EXTRAPOLATED_S = 0.5
MAX_YAW_ERROR_RAD = 0.05  # acted upon at once: turns of 0.5 rad/s, and roll and pitch keep most of the thrust
TAKE_OFF_M = 0.05  # above where its odometry began


class CommandedFlight(SimulatedFlight):
    """At first they stand on the ground. The rotors of each rest until it is asked to be TAKE_OFF_M above where its
    odometry began; from then on they turn. Who has been asked for nothing yet stays where its odometry began."""

    def __init__(self, config: WorldConfig, fleet: Fleet) -> None:
        super().__init__(config, fleet)
        self._autopilot = Autopilot(self._physics.airframe, fleet.mavs, MAX_YAW_ERROR_RAD)
        self._physics.thrusts[:] = 0.0
        self._turning = np.zeros((fleet.mavs, 1), bool)  # whether its rotors do
        self._frames = self._frames_now()
        self._stamp_s = np.zeros(fleet.mavs)
        # Of each MAV's setpoint at its stamp, in its odometry frame.
        self._position, self._velocity, self._acceleration = (np.zeros((fleet.mavs, 3)) for _ in range(3))
        self._heading = np.zeros(fleet.mavs)

    def command(self, setpoints: Iterable[messages.Setpoint]) -> None:
        for setpoint in setpoints:
            i = setpoint.sender - 1
            self._stamp_s[i] = setpoint.stamp_ns / 1e9
            self._position[i] = messages.floats(setpoint.position)
            self._velocity[i] = messages.floats(setpoint.velocity)
            self._acceleration[i] = messages.floats(setpoint.acceleration)
            self._heading[i] = setpoint.yaw

    def begin_odometry(self, mav: int) -> None:
        """What was asked for in the former frame means nothing in this one: it stays where it is."""
        super().begin_odometry(mav)
        for asked in (self._position, self._velocity, self._acceleration, self._heading):
            asked[mav - 1] = 0.0

    def step(self) -> None:
        self._frames = self._frames_now()
        super().step()

    def _frames_now(self) -> Array:
        """(N, 4) poses of the odometry frames in the world, as each MAV's VIO has them at this tick."""
        return compose(self.true.level, inverse(self.vio.level))

    def _wanted(self, time_s: float) -> Setpoints:
        since_s = time_s - self._stamp_s[:, None]
        moved_s, moving = np.minimum(since_s, EXTRAPOLATED_S), since_s < EXTRAPOLATED_S
        position = self._position + self._velocity * moved_s + self._acceleration * moved_s**2 / 2
        velocity = np.where(moving, self._velocity + self._acceleration * moved_s, 0.0)
        acceleration = np.where(moving, self._acceleration, 0.0)
        self._turning |= position[:, 2:] > TAKE_OFF_M
        place, yaw = self._frames[:, :3], self._frames[:, 3]
        return Setpoints(
            place + rotate_z(yaw, position),
            rotate_z(yaw, velocity),
            rotate_z(yaw, acceleration),
            yaw + self._heading,
        )

    def _thrusts(self) -> Array:
        return np.asarray(self._turning * super()._thrusts())
