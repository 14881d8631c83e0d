"""Where was a MAV whose odometry was lost? On the chord between the readings before and after: these are poses."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array, wrap


class Completed(NamedTuple):
    """Of the T last ticks, oldest first."""

    z: Array  # (T, N, 4) x y z m, yaw rad; NaN where nothing was read before, or nothing after
    between: npt.NDArray[np.intp]  # (T, N) of interpolated readings: ticks between the two they lie between, else 0


def completed(z: Array, longest: int) -> Completed:
    """Readings (T, N, 4), NaN where there is none, with those interpolated that lie between two not further apart than
    so many ticks."""
    z, read, between = z.copy(), np.isfinite(z[..., 3]), np.zeros(z.shape[:2], np.intp)
    if read.all():
        return Completed(z, between)
    at, T = np.arange(len(z))[:, None], len(z)
    before = np.maximum.accumulate(np.where(read, at, -1))
    after = np.minimum.accumulate(np.where(read, at, T)[::-1])[::-1]
    lost = ~read & (before >= 0) & (after < T) & (after - before <= longest)
    between[lost] = (after - before)[lost]
    k, i = lost.nonzero()
    first, last = z[before[k, i], i], z[after[k, i], i]
    chord = last - first
    chord[:, 3] = wrap(chord[:, 3])
    z[k, i] = first + chord * ((k - before[k, i]) / between[k, i])[:, None]
    return Completed(z, between)
