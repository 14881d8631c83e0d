"""How far has each MAV moved since the last tick? As its odometry says; where that is missing, a guess with its error.

A MAV that is not heard goes on as it last did, by the mean of its last increments (one of them alone carries as much
drift as motion). How far such guesses are off is learnt from how far they have been off for the whole team, readings
come in the end: little in hover, much in a manoeuvre. A silence longer than what is learnt from ends in standing
still, with a variance that grows without bound.

What a guess is off by is motion. VIO drift is not in it: a MAV that coasts moves, its unheard reading drifts away from
where it is (`prediction.py`).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.estimator.gating import chi_square_quantile
from agent.interface.fleet import Fleet
from agent.interface.frames import Array, wrap

MEAN_S = 0.5  # over which increments are averaged
HORIZON_S = 1.0  # so far ahead a guess is made and judged; then the velocity fades
FADING_S = 1.0  # time constant
MEMORY_S = 5.0  # of how good guesses were
FIRST = (0.3, 0.1)  # m/s^2 per axis, rad/s^2: manoeuvres as long as nothing is known of them
LEAST = (0.02, 0.005)  # m/s^2, rad/s^2: nobody is believed to stay for good
SETS_OUT = (0.25, 0.1)  # m/s per axis, rad/s: so fast flies, in the end, also who was at rest when last heard
MOST = (5.0, 5.0)  # m/s^2, rad/s^2: nothing more is learnt from a guess that was off by more than this makes
FIRST_COUNTS = 20.0  # errors that FIRST is worth
FASTEST_M_S, FASTEST_RAD_S = 15.0, 10.0  # beyond, an odometry has not flown but begun anew
BEGUN_ANEW = 1 - 1e-6  # as is one that is further off after a silence than this share of them would be ...
TURNS = (1.0, 0.3)  # m/s^2, rad/s^2: ... of MAVs that manoeuvre so

Mask = npt.NDArray[np.bool_]
Ticks = npt.NDArray[np.intp]


class Step(NamedTuple):
    """From one tick to the next, of all MAVs and the start (N + 1)."""

    motion: "Motion"
    increments: Array  # (N + 1, 4) of the odometry poses: m, rad
    sigma: Array  # (N + 1, 2) standard deviation of an increment, per axis m and rad
    coasting: Mask  # (N + 1,) whose increment is a guess of its motion


@dataclass(frozen=True)
class Model:
    """What is the same at all ticks."""

    tick_s: float
    mean: int  # ticks
    horizon: int  # ticks
    reading: Array  # (4,) variance
    increment_sigma: Array  # (2,) of two readings' difference: standard deviation, per axis m and rad
    drift: Array  # (4,) variance per tick
    ahead: Array  # (horizon,) 1, 2, ...: ticks

    @staticmethod
    def of(config: AgentConfig, fleet: Fleet) -> "Model":
        f, drift = config.filter, config.odometry
        horizon = max(2, round(HORIZON_S * fleet.rate_hz))
        return Model(
            1 / fleet.rate_hz,
            max(2, round(MEAN_S * fleet.rate_hz)),
            horizon,
            _of_pose(f.odometry_sigma_m, f.odometry_sigma_rad) ** 2,
            np.multiply(np.sqrt(2.0), (f.odometry_sigma_m, f.odometry_sigma_rad)),
            _of_pose(drift.position_sigma_m, drift.yaw_sigma_rad) ** 2,
            np.arange(1.0, horizon + 1),
        )

    def square_off(self, accelerations: tuple[float, float], ticks: Array) -> Array:
        """(..., 4) square of how far a guess is off after so many ticks (...) of a constant acceleration, which the
        mean velocity follows late; m^2 and rad^2."""
        of_one: Array = 0.5 * self.tick_s**2 * ticks * (ticks + self.mean)
        return np.multiply.outer(of_one, _of_pose(*accelerations)) ** 2

    def may_move(self, moved: Array, ticks: int) -> Mask:
        """(...) whether anybody flies that far (..., 4; m, rad) in so many ticks; not if it is NaN."""
        time_s, straight = ticks * self.tick_s, moved[..., :3]
        near = np.vecdot(straight, straight) <= (FASTEST_M_S * time_s) ** 2
        return np.asarray(near & (np.abs(wrap(moved[..., 3])) <= FASTEST_RAD_S * time_s))

    @cached_property
    def least(self) -> Array:
        return self.square_off(LEAST, self.ahead)

    @cached_property
    def most(self) -> Array:
        return self.square_off(MOST, self.ahead)[:, None]

    @cached_property
    def drifts(self) -> Array:
        return np.multiply.outer(self.ahead, self.drift)

    @cached_property
    def memory(self) -> float:
        return math.exp(-self.tick_s / MEMORY_S)


@dataclass(frozen=True)
class Motion:
    """Of all MAVs and the start; never changed, but replaced."""

    model: Model
    past: Array  # (T, N + 1, 4) the last readings, newest last; NaN where there was none
    velocities: Array  # (horizon, N + 1, 4) per tick, as they were estimated then
    here: Array  # (N + 1, 4) the newest readings, or where the guesses have got to; NaN for who was never heard
    unheard: Ticks  # (N + 1,) ticks since the last reading
    between: Ticks  # (N + 1,) of a newest reading that is interpolated: ticks between the two it lies between, else 0
    errors: Array  # (horizon, 4) sum of squares of how far guesses were off, fading
    counts: Array  # (horizon, 1) of them

    @staticmethod
    def begin(model: Model, mavs: int) -> "Motion":
        bodies = mavs + 1
        spread = model.square_off(FIRST, model.ahead)
        spread += np.multiply.outer(model.ahead + model.ahead**2 / model.mean, model.drift)
        return Motion(
            model,
            np.full((max(model.mean, model.horizon), bodies, 4), np.nan),
            np.zeros((model.horizon, bodies, 4)),
            np.full((bodies, 4), np.nan),
            np.zeros(bodies, np.intp),
            np.zeros(bodies, np.intp),
            spread * FIRST_COUNTS,
            np.full((model.horizon, 1), FIRST_COUNTS),
        )

    def step(self, z: Array, between: Ticks) -> Step:
        """One tick later.

        Args:
            z: (N + 1, 4) x y z m, yaw rad of every odometry; NaN where there is no reading.
            between: (N + 1,) 0, or where z is interpolated: ticks between the two readings it lies between.
        """
        model = self.model
        increments = z - self.past[-1]
        increments[:, 3] = wrap(increments[:, 3])
        sigma = np.empty((len(z), 2))
        sigma[:] = model.increment_sigma
        heard, coasting = np.isfinite(z[:, 3]), np.isnan(increments[:, 3])
        # An increment takes two readings in a row. Without them a MAV goes on as it last did; where that took it is
        # for the reading that ends the silence, and for detections, to say.
        if coasting.any():
            ticks, velocity = self.unheard[coasting] + 1, self.velocities[-1, coasting]
            increments[coasting] = velocity * self._fading(ticks)[:, None]
            sigma[coasting] = np.sqrt(self._growth(ticks, velocity))
        read = heard
        if between.any() or self.between.any():
            read = heard & (between == 0)
            # The first that is interpolated, and the next reading
            for body in np.flatnonzero((between > 0) != (self.between > 0)):
                sigma[body] = np.sqrt(self._interpolated(int(max(between[body], self.between[body]))))
        errors, counts = self._learnt(z, read)
        here, unheard = z, np.zeros(len(z), np.intp)
        if not heard.all():
            here = np.where(heard[:, None], z, self.here + increments)
            unheard = np.where(heard, unheard, self.unheard + 1)
        past = np.concatenate([self.past[1:], z[None]])
        velocities = np.concatenate([self.velocities[1:], self._velocity(z, heard)[None]])
        moved = Motion(model, past, velocities, here, unheard, between, errors, counts)
        return Step(moved, increments, sigma, coasting)

    @property
    def silent(self) -> Mask:
        """(N + 1,) who was not heard for longer than guesses are judged for."""
        return np.asarray(self.unheard > self.model.horizon)

    def _velocity(self, z: Array, heard: Mask) -> Array:
        """(N + 1, 4) per tick: the mean of the last increments, less what drift alone would make of it."""
        model = self.model
        window = self.past[-model.mean :]
        known = np.isfinite(window[..., 3])
        if known.all():
            moved, ticks = z - window[0], np.full((len(z), 1), float(model.mean))
        else:
            oldest = known.argmax(axis=0)
            moved, ticks = z - window[oldest, np.arange(len(z))], (model.mean - oldest)[:, None].astype(np.float64)
        moved[:, 3] = wrap(moved[:, 3])
        squares = moved * moved
        squares[:, :3] = squares[:, :3].sum(axis=1, keepdims=True)
        moved *= np.maximum(1 - ticks * (model.drift * _AXES) / np.maximum(squares, 1e-12), 0.0) / ticks
        fresh = heard & known.any(axis=0)
        return moved if fresh.all() else np.asarray(np.where(fresh[:, None], moved, self.velocities[-1]))

    def _learnt(self, z: Array, read: Mask) -> tuple[Array, Array]:
        """Errors and counts after these readings."""
        model = self.model
        guess = model.ahead[:, None, None] * self.velocities[::-1, :-1]
        guess += self.past[: -1 - model.horizon : -1, :-1]
        off = z[:-1] - guess
        off[..., 3] = wrap(off[..., 3])
        off *= off
        known = np.isfinite(off[..., 3])
        if not read.all():
            known &= read[:-1]
        off = np.where(known[..., None], np.minimum(off, model.most), 0.0)
        counts = model.memory * self.counts + known.sum(axis=1, keepdims=True)
        return model.memory * self.errors + off.sum(axis=1), counts

    def _spread(self) -> Array:
        """(horizon + 1, 2) variance of a guess after 0, 1, ... ticks, per axis and of yaw; drift not counted."""
        model = self.model
        found = np.maximum(self.errors / self.counts - model.drifts, model.least)
        spread = np.zeros((model.horizon + 1, 2))
        spread[1:, 0], spread[1:, 1] = found[:, :3].mean(axis=1), found[:, 3]
        return np.maximum.accumulate(spread)

    def _growth(self, ticks: Ticks, velocity: Array) -> Array:
        """(n, 2) by which the variance grows in the tick that is so many (n,) after the last reading."""
        horizon, spread = self.model.horizon, self._spread()
        within = np.minimum(ticks, horizon)
        growth = spread[within] - spread[within - 1]
        beyond = ticks > horizon
        if beyond.any():
            square = np.stack([(velocity[:, :3] ** 2).mean(1), velocity[:, 3] ** 2], axis=1)
            growth = np.where(beyond[:, None], np.maximum(growth, self._walk(ticks, square)), growth)
        return np.asarray(growth + 2 * self.model.reading[[0, 3]])

    def _walk(self, ticks: Ticks, square: Array) -> Array:
        """(n, 2) the same for velocities of these squares (n, 2) that fade, if those that take their place are of an
        Ornstein-Uhlenbeck process that begins at the horizon."""
        tick_s = self.model.tick_s
        begun = 1 - self._fading(ticks)
        square = square + (np.array(SETS_OUT) * tick_s) ** 2
        return np.asarray(2 * FADING_S / tick_s * square * (begun * begun)[:, None])

    def _fading(self, ticks: Ticks) -> Array:
        """(n,) of the velocity, so many ticks (n,) after the last reading."""
        return np.asarray(np.exp(-np.maximum(ticks - self.model.horizon, 0) * self.model.tick_s / FADING_S))

    def _interpolated(self, ticks: int) -> Array:
        """(2,) variance of a reading interpolated within so many ticks: a guess is off by a t (t + mean) / 2 of an
        acceleration a, a chord by a t^2 / 8."""
        spread = self._spread()[min(ticks, self.model.horizon)]
        share = (ticks / (4 * (ticks + self.model.mean))) ** 2
        return np.asarray(spread * share + 2 * self.model.reading[[0, 3]])

    def begun_anew(self, last: Array, reading: Array, ticks: int, unheard: int, velocity: Array) -> bool:
        """Whether two readings are not of the same odometry.

        Args:
            last: (4,) the earlier reading, or where guesses had got to since.
            reading: (4,) the next.
            ticks: from one to the other.
            unheard: ticks for which guesses had gone on.
            velocity: (4,) per tick, then.
        """
        model, silence = self.model, unheard + ticks
        if not np.isfinite(last[3]):
            return False
        moved = reading - last
        moved[3] = wrap(moved[3])
        if not model.may_move(moved, ticks):
            return True
        if silence == 1:
            return False
        off = moved - velocity * self._fading(np.arange(unheard + 1, silence + 1)).sum()
        off[3] = wrap(off[3])
        learnt = self._spread()[min(silence, model.horizon)] + silence * model.drift[[0, 3]]
        position, yaw = learnt + model.square_off(TURNS, np.array(float(silence)))[[0, 3]]
        return float((off[:3] ** 2).sum() / position + off[3] ** 2 / yaw) > chi_square_quantile(BEGUN_ANEW, 4)

    def without(self, bodies: list[int]) -> "Motion":
        """Nothing is known of these any more."""
        past, velocities, here = self.past.copy(), self.velocities.copy(), self.here.copy()
        past[:, bodies] = here[bodies] = np.nan
        velocities[:, bodies] = 0.0
        return replace(self, past=past, velocities=velocities, here=here)


_AXES = np.array([3.0, 3.0, 3.0, 1.0])  # over how many a square is summed


def _of_pose(position: float, yaw: float) -> Array:
    return np.array([position, position, position, yaw])
