"""What does a MAV do that has nothing to do? It stays where its odometry first had it."""

from dataclasses import dataclass

from agent.interface.frames import Array


@dataclass
class Hold:
    pose: Array | None = None  # (4,) x y z m, yaw rad in the odometry frame

    def setpoint(self, odometry: Array) -> Array:
        """The pose (4,) to hold, given the present one."""
        if self.pose is None:
            self.pose = odometry
        return self.pose
