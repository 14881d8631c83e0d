"""How does the wind blow? A steady wind and gusts, the same for all MAVs.

MuJoCo makes a force of it: the drag of the air on a body's equivalent inertia box, 0.44 N on a level MAV in 5 m/s.
"""

import math

import msgspec
import numpy as np

from agent.interface.frames import Array
from agent.interface.seeds import generator


class Wind(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    mean_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)  # where it blows to, in the world frame
    gust_sigma_m_s: float = 0.0  # standard deviation of the gusts, per axis
    gust_time_s: float = 1.0  # after which a gust has faded to 1/e

    def __post_init__(self) -> None:
        if not all(abs(each) <= 30 for each in self.mean_m_s):
            raise ValueError(f"mean_m_s = {list(self.mean_m_s)}: expected three, each of -30 to 30 m/s")
        if not 0 <= self.gust_sigma_m_s <= 30:
            raise ValueError(f"gust_sigma_m_s = {self.gust_sigma_m_s!r}: expected 0 to 30 m/s")
        if not 0.01 <= self.gust_time_s <= 3600:
            raise ValueError(f"gust_time_s = {self.gust_time_s!r}: expected 0.01 to 3600 s")


class Gusts:
    """The mean and an Ornstein-Uhlenbeck process about it, which is stationary from the start."""

    def __init__(self, wind: Wind, seed: int, step_s: float) -> None:
        self._mean, self._random = np.array(wind.mean_m_s), generator(seed, "wind")
        self._kept = math.exp(-step_s / wind.gust_time_s)
        self._added = wind.gust_sigma_m_s * math.sqrt(1 - self._kept**2)
        self._gust = wind.gust_sigma_m_s * self._random.standard_normal(3)

    def step(self) -> Array:
        """The velocity (3,) m/s of the air in the next step."""
        now = self._mean + self._gust
        self._gust = self._kept * self._gust + self._added * self._random.standard_normal(3)
        return now
