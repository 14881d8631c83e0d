"""How does a MAV get from where it is to where it shall be? By a minimum-snap trajectory, within limits.

Of all trajectories through the waypoints at their times it has the least integral of squared snap, which is what the
rotors' torques follow (Mellinger and Kumar 2011). It is of degree 7 between waypoints and continuous to the 6th
derivative. As in Richter, Bry and Roy (2013) the quadratic programme's equality constraints are put in, not solved
with: unknown are velocity, acceleration and jerk at the inner waypoints, which any two segments share, and what is left
to solve is positive definite. Polynomials are in the share of their own segment's time, from 0 to 1.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agent.interface.frames import Array

ORDERS, TERMS = 4, 8  # position to jerk are given at both ends of a segment, which takes 8 coefficients
PEAK_SPEED = 35 / 16  # from rest to rest, in units of distance / duration
PEAK_ACCELERATION = 84 * math.sqrt(5) / 25  # from rest to rest, in units of distance / duration^2
STEPS_PER_S = 10  # durations are whole steps
SAMPLES = 101  # of a trajectory, for its extremes: they are missed by less than a thousandth
BACK = 6.0  # speed / acceleration limit: 5.1 of them take a MAV that only moves to rest where it was
SETTLING_S = 10.0  # longer than that and twice the way from rest: when to give up from a moving begin
AT_ONCE = 32  # durations tried


class Sample(NamedTuple):
    """Of a trajectory, at one time."""

    position: Array  # (3,) m
    velocity: Array  # (3,) m/s
    acceleration: Array  # (3,) m/s^2
    jerk: Array  # (3,) m/s^3

    @staticmethod
    def rest(position: Array) -> "Sample":
        return Sample(position, np.zeros(3), np.zeros(3), np.zeros(3))


class Limits(NamedTuple):
    speed_m_s: float
    acceleration_m_s2: float


@dataclass(frozen=True)
class Trajectory:
    times_s: Array  # (S + 1,) of the waypoints, from 0
    coefficients: Array  # (S, 8, 3) m, constant term first, of the share of the segment's time

    @property
    def duration_s(self) -> float:
        return float(self.times_s[-1])

    def at(self, time_s: float) -> Sample:
        """Before 0 it is where it begins, after the end at rest where it ends."""
        if time_s >= self.duration_s:
            return Sample.rest(self.coefficients[-1].sum(axis=0))
        after = max(time_s, 0.0)
        segment = int(np.searchsorted(self.times_s, after, side="right")) - 1
        length = self.times_s[segment + 1] - self.times_s[segment]
        by_share = _derivatives((after - self.times_s[segment]) / length) @ self.coefficients[segment]
        return Sample(*(by_share / length ** np.arange(ORDERS)[:, None]))


def minimum_snap(waypoints: Array, times_s: Array, begin: Sample | None = None) -> Trajectory:
    """The trajectory through these (W, 3) waypoints, m, at these (W,) times, s, that ends at rest.

    Args:
        times_s: from 0, rising.
        begin: at the first waypoint, with the velocity, acceleration and jerk to go on with. None is at rest.

    Raises:
        ValueError: that is not what they are, or something is not finite.
    """
    waypoints, times_s = np.array(waypoints, np.float64), np.array(times_s, np.float64)
    if waypoints.ndim != 2 or waypoints.shape[1] != 3 or len(waypoints) < 2 or not np.isfinite(waypoints).all():
        raise ValueError(f"waypoints = {waypoints.tolist()}: expected two or more, each three finite numbers, m")
    from_0 = times_s.shape == waypoints.shape[:1] and times_s[0] == 0 and times_s[-1] < math.inf
    if not (from_0 and (times_s[1:] > times_s[:-1]).all()):
        raise ValueError(f"times_s = {times_s.tolist()}: expected {len(waypoints)} finite numbers rising from 0, s")
    nodes = np.zeros((len(waypoints), ORDERS, 3))
    nodes[:, 0] = waypoints
    if begin is not None:
        nodes[0, 1:] = _checked(begin)[1:]
        if not np.allclose(begin.position, waypoints[0], rtol=0, atol=1e-6):
            raise ValueError(f"begin.position = {list(begin.position)}: expected the first waypoint, {waypoints[0]} m")

    lengths = np.diff(times_s)
    units = lengths[:, None] ** np.tile(np.arange(ORDERS), 2)  # (S, 8) of derivatives by the share of the time
    cost = np.zeros((nodes.size // 3, nodes.size // 3))
    for segment, unit in enumerate(units):
        both = slice(ORDERS * segment, ORDERS * segment + TERMS)
        cost[both, both] += np.outer(unit, unit) * _COST / lengths[segment] ** (TERMS - 1)
    free = np.full(nodes.shape[:2], True)
    free[:, 0] = free[0] = free[-1] = False
    free = free.ravel()
    flat, within = nodes.reshape(-1, 3), cost[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.diag(within))[:, None]  # segments of very different times meet here
    pull = cost[np.ix_(free, ~free)] @ flat[~free]
    flat[free] = -scale * np.linalg.solve(scale * within * scale.T, scale * pull)
    ends = np.concatenate([nodes[:-1], nodes[1:]], axis=1)
    return Trajectory(times_s, _HERMITE @ (units[:, :, None] * ends))


def through(waypoints: Array, least_s: float, begin: Sample, limits: Limits) -> Trajectory:
    """The trajectory through these (W, 3) waypoints, m, that keeps the limits; each leg takes its share of the time.

    It takes `least_s`, which does for the straight way, or longer where there are waypoints between; up to four times,
    after which limits are not looked at any more.
    """
    legs = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    shares = np.concatenate([[0.0], np.cumsum(legs) / legs.sum()]) if len(legs) > 1 else np.array([0.0, 1.0])
    duration_s = least_s
    while True:
        planned = minimum_snap(waypoints, duration_s * shares, begin)
        if len(legs) == 1 or duration_s > 4 * least_s or _keeps(planned, limits):
            return planned
        duration_s = _steps(1.1 * duration_s) / STEPS_PER_S


def _keeps(planned: Trajectory, limits: Limits) -> bool:
    samples = [planned.at(time_s) for time_s in np.linspace(0, planned.duration_s, SAMPLES)]
    speed, acceleration = (max(np.linalg.norm(each[n]) for each in samples) for n in (1, 2))
    return bool(speed <= limits.speed_m_s and acceleration <= limits.acceleration_m_s2)


def duration_within(begin: Sample, goal: Array, limits: Limits, least_s: float = 0.0) -> float:
    """The shortest duration, s, in which the trajectory from here to rest at this (3,) goal, m, keeps the limits.

    It is rounded up to 0.1 s, and at least `least_s`. A limit that the begin itself exceeds is taken to be what it has.
    From rest there always is one. From a moving begin there need not be: what a begin's acceleration and jerk add to
    the speed grows with the duration. Then it is infinite; to come to rest first, or wider limits, will do.

    Raises:
        ValueError: something is not finite, or a limit is not positive.
    """
    state, way = _checked(begin), _vector("goal", goal, "m") - begin.position
    for name, value, unit in zip(Limits._fields, limits, ("m/s", "m/s^2"), strict=True):
        if not 0 < value < math.inf:
            raise ValueError(f"limits.{name} = {value}: expected a positive finite number, {unit}")
    if not 0 <= least_s < math.inf:
        raise ValueError(f"least_s = {least_s}: expected a finite number of at least 0, s")
    distance = math.sqrt(way @ way)
    from_rest_s = max(
        PEAK_SPEED * distance / limits.speed_m_s, math.sqrt(PEAK_ACCELERATION * distance / limits.acceleration_m_s2)
    )
    if not state[1:].any():
        return _steps(max(from_rest_s, least_s)) / STEPS_PER_S
    own = np.sqrt(np.vecdot(state[1:3], state[1:3]))
    allowed = np.maximum(limits, own) * (1 + 1e-9)
    first = _steps(max(distance / allowed[0], least_s))
    last = first + _steps(2 * from_rest_s + BACK * own[0] / limits.acceleration_m_s2 + SETTLING_S)
    for step in range(first, last + 1, AT_ONCE):
        durations_s = np.arange(step, step + AT_ONCE) / STEPS_PER_S
        keeps = (_peaks(state, way, durations_s) <= allowed).all(axis=1)
        if keeps.any():
            return float(durations_s[keeps.argmax()])
    return math.inf


def _peaks(state: Array, way: Array, durations_s: Array) -> Array:
    """(D, 2) largest speed, m/s, and acceleration, m/s^2, of trajectories of these (D,) durations from a begin (4, 3)
    to rest at a (3,) way from it, m."""
    units = durations_s[:, None] ** np.arange(ORDERS)
    ends = units[:, :, None] * state  # (D, 4, 3)
    ends[:, 0] = -way  # relative to the goal, so that the end does not count
    of_one = np.tensordot(ends, _SHAPES, axes=(1, 2))  # (D, 3, SAMPLES, 2) by the share of the time
    return np.asarray(np.sqrt((of_one**2).sum(axis=1).max(axis=1)) / units[:, 1:3])


def _steps(duration_s: float) -> int:
    """How many are as long: at least one, and not one more for a rounding error."""
    return max(math.ceil(duration_s * STEPS_PER_S - 1e-9), 1)


def _checked(begin: Sample) -> Array:
    """The sample as (4, 3)."""
    units = ("m", "m/s", "m/s^2", "m/s^3")
    rows = zip(Sample._fields, begin, units, strict=True)
    return np.array([_vector(f"begin.{name}", value, unit) for name, value, unit in rows])


def _vector(name: str, value: Array, unit: str) -> Array:
    if np.shape(value) != (3,) or not np.isfinite(value).all():
        raise ValueError(f"{name} = {np.asarray(value).tolist()}: expected three finite numbers, {unit}")
    return value


def _derivatives(share: Array | float) -> Array:
    """(..., 4, 8) position to jerk, by the share (...) of a segment's time, of each power of it."""
    return np.asarray(_FALLING * np.asarray(share)[..., None, None] ** _POWERS)


_POWERS = np.maximum(np.arange(TERMS) - np.arange(ORDERS)[:, None], 0)
_FALLING = np.array([[math.perm(n, m) for n in range(TERMS)] for m in range(ORDERS)], np.float64)
_HERMITE = np.linalg.inv(_derivatives(np.array([0.0, 1.0])).reshape(TERMS, TERMS))  # coefficients from both ends
_SNAP = np.array([math.perm(n, 4) for n in range(TERMS)])
_OF_TWO = np.maximum(np.add.outer(np.arange(TERMS), np.arange(TERMS)) - 7, 1)  # integrals of powers n - 4 + m - 4
_COST = _HERMITE.T @ (np.outer(_SNAP, _SNAP) / _OF_TWO) @ _HERMITE  # squared snap, from both ends
_SHAPES = (_derivatives(np.linspace(0, 1, SAMPLES)) @ _HERMITE)[:, 1:3, :ORDERS]  # (SAMPLES, 2, 4) from the begin
