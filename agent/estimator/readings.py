"""What has each MAV's odometry said in the last ticks, and is it still the same odometry?

Of the ticks that are kept and as many before: what is lost lies between two readings.
"""

import numpy as np
import numpy.typing as npt

from agent.estimator.completion import Completed, completed
from agent.estimator.motion import Motion
from agent.interface.frames import Array


class Readings:
    """Of `mavs` MAVs, up to the newest tick."""

    def __init__(self, mavs: int, lag: int) -> None:
        """For ticks that are kept as long as `lag` others come after them."""
        self._lag, self._now = lag, 0
        self._z = np.full((2 * lag + 2, mavs, 4), np.nan)  # newest last; NaN where there is none
        self._since = np.full(mavs, -1, np.intp)  # the last tick before the odometry of each began anew
        self._news: list[tuple[int, int]] = []  # tick and MAV of readings that came since `read`

    def advance(self, tick: int, by: int) -> None:
        """This tick is the newest; so many later than the one before."""
        new = np.full((min(by, len(self._z)), *self._z.shape[1:]), np.nan)
        self._z, self._now = np.concatenate([self._z[len(new) :], new]), tick
        self._news = [(then, mav) for then, mav in self._news if then >= tick - self._lag]  # what is kept

    def belongs(self, tick: int, mav: int) -> bool:
        """Whether what this MAV said then is of the odometry that it has now."""
        return tick > int(self._since[mav - 1])

    def put(self, tick: int, mav: int, reading: Array) -> None:
        """(4,) x y z m, yaw rad; the first of a tick counts."""
        row = self._z[tick - self._now - 1]
        if np.isnan(row[mav - 1, 3]):
            row[mav - 1] = reading
            self._news.append((tick, mav))

    @property
    def newest(self) -> Array:
        """(N, 4)"""
        newest: Array = self._z[-1]
        return newest

    def whole(self, ticks: int) -> bool:
        """Whether none is missing in so many last ticks."""
        return bool(np.isfinite(self._z[-ticks:]).all())

    def completed(self, ticks: int) -> Completed:
        """Of so many last ticks."""
        z, between = completed(self._z, self._lag + 1)
        return Completed(z[-ticks:], between[-ticks:])

    def read(self) -> None:
        """All that came has been looked at."""
        self._news.clear()

    def forget(self, mav: int, tick: int) -> None:
        """What was before this tick: there the odometry of this MAV began anew."""
        self._since[mav - 1] = tick - 1
        self._z[: max(tick - self._now - 1 + len(self._z), 0), mav - 1] = np.nan

    def forget_all(self) -> None:
        """But those of the newest tick."""
        self._z[:-1] = np.nan

    def begun_anew(self, first: int, then: Motion, velocities: Array) -> list[int]:
        """MAVs of which a reading came that is not of the same odometry as those before, which are forgotten.

        Args:
            first: the oldest tick that is kept.
            then: what was known before it.
            velocities: (N + 1, 4) per tick, now.
        """
        found: dict[int, int] = {}
        for tick, mav in sorted(self._news) if self._any_jumps(then) else ():
            if mav not in found and self._jumps(tick, mav, first, then, velocities[mav - 1]):
                found[mav] = tick
        for mav, tick in found.items():
            self.forget(mav, tick)
        return sorted(found)

    def _any_jumps(self, motion: Motion) -> bool:
        """Whether any may be of another odometry: not if all are news of now, and near those of the tick before."""
        rows = [mav - 1 for tick, mav in self._news if tick == self._now]
        moved = self._z[-1, rows] - self._z[-2, rows]
        return len(rows) < len(self._news) or not motion.model.may_move(moved, 1).all()

    def _jumps(self, tick: int, mav: int, first: int, then: Motion, velocity: Array) -> bool:
        index = tick - self._now - 1 + len(self._z)
        read: npt.NDArray[np.intp] = np.flatnonzero(np.isfinite(self._z[:index, mav - 1, 3]))
        if len(read):
            last, unheard, ticks = self._z[read[-1], mav - 1], 0, index - int(read[-1])
        else:
            last, unheard, ticks = then.here[mav - 1], int(then.unheard[mav - 1]), tick - first + 1
        return then.begun_anew(last, self._z[index, mav - 1], ticks, unheard, velocity)
