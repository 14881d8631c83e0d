"""What does each MAV's visual-inertial odometry read? The true motion since the tick before, with noise, added up."""

import numpy as np

from agent.interface.fleet import Fleet
from agent.interface.frames import compose, relative_pose
from agent.interface.seeds import generator
from agent.interface.sensors import Odometry
from world.poses import Poses, turn_z


class Vio:
    """The VIO of all MAVs. An odometry frame lies where its MAV is at tick 0, or at the tick at which it begins
    anew; so every MAV first reads 0 and no yaw."""

    def __init__(self, odometry: Odometry, fleet: Fleet, start: Poses) -> None:
        self.pose_world_odom = start.level  # (N, 4), true
        self._sigmas = np.array([odometry.position_sigma_m] * 3 + [odometry.yaw_sigma_rad])
        self._generators = [generator(fleet.seed, f"vio/{mav}") for mav in fleet.ids]
        self._last, self._true = start.level, start
        self._read = np.zeros_like(start.level)
        self.poses = self._with_true_tilt(start)

    def begin(self, i: int) -> None:
        """The MAV of index i begins anew: from now on its odometry frame lies where it is at this tick."""
        self.pose_world_odom[i] = self._last[i]
        self._read[i] = 0.0
        self.poses = self._with_true_tilt(self._true)

    def advance(self, true: Poses) -> None:
        """The next tick's reading, from the true poses in the world; roll and pitch are observable and stay true."""
        level = true.level
        noise = np.array([each.standard_normal(4) for each in self._generators])
        self._read = compose(self._read, relative_pose(self._last, level) + self._sigmas * noise)
        self._last, self._true = level, true
        self.poses = self._with_true_tilt(true)

    def _with_true_tilt(self, true: Poses) -> Poses:
        return Poses(self._read[:, :3], turn_z(self._read[:, 3] - self._last[:, 3], true.quaternion))
