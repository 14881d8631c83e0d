"""What does a MAV do that has nothing to do? It stays where its odometry first had it."""

from dataclasses import dataclass

from agent.controller.trajectory import Sample
from agent.interface.frames import Array


@dataclass
class Hold:
    position: Array | None = None  # (3,) m in the odometry frame

    def fly(self, odometry: Array) -> Sample:
        """To stay at the first place that this was asked at, given the present pose (4,)."""
        if self.position is None:
            self.position = odometry[:3]
        return Sample.rest(self.position)
