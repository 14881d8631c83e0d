"""What does a rough knowledge of the odometry frames say of a MAV's pose, once its odometry is read?"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from agent.interface.frames import Array, compose


class Joint(NamedTuple):
    """Of all MAVs and the start; only the rows of those that were asked for have a meaning."""

    y: Array  # (N + 1, 4) poses in the common frame
    Sigma: Array  # (4 (N + 1), 4 (N + 1))


@dataclass(frozen=True)
class Prior:
    """On the odometry frames of those who are still awaited, in that of the station."""

    frames: Array  # (N, 4) x y z m, yaw rad; NaN for who is not awaited
    position_sigma_m: float  # per axis
    yaw_sigma_rad: float

    def of(self, odometry: Array) -> list[int]:
        """Rows of those of whom there is a reading, (N, 4) with NaN for none."""
        return [int(row) for row in np.flatnonzero(np.isfinite(self.frames[:, 3] + odometry[:, 3]))]

    def without(self, rows: list[int]) -> "Prior | None":
        """With these no longer awaited; None if nobody is."""
        frames = self.frames.copy()
        frames[rows] = np.nan
        return replace(self, frames=frames) if np.isfinite(frames[:, 3]).any() else None

    def poses(self, odometry: Array) -> Joint:
        """Of those who are awaited and of whom there is a reading (N, 4), each on its own."""
        y = np.nan_to_num(np.vstack([compose(self.frames, odometry), np.zeros(4)]))
        Sigma = np.eye(len(y) * 4).reshape(len(y), 4, len(y), 4)
        variances = np.diag([self.position_sigma_m**2] * 3 + [self.yaw_sigma_rad**2])
        for row in self.of(odometry):
            arm = y[row] - self.frames[row]
            J = np.eye(4)
            J[:2, 3] = -arm[1], arm[0]
            Sigma[row, :, row] = J @ variances @ J.T
        return Joint(y, Sigma.reshape(4 * len(y), -1))
