"""Along which curve does a MAV fly, so that its rotors have least to do? Minimum snap (Mellinger and Kumar 2011).

Between waypoints the curve is a polynomial of degree 7. The one of least integrated squared snap is that whose first
six derivatives are continuous at the inner waypoints; with position, velocity, acceleration and jerk given at both ends
these conditions are as many as the coefficients, so it takes one linear solve and no optimiser.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agent.interface.frames import Array

TERMS, ENDS = 8, 4  # coefficients of a piece; derivatives given at either end, the zeroth among them
PEAK_SPEED = 35 / 16  # of a way from rest to rest, in units of distance / duration
PEAK_ACCELERATION = 84 * math.sqrt(5) / 25  # in units of distance / duration^2
STEP_S = 0.1  # durations are multiples of it
LONGER, TRIES, SAMPLES = 1.15, 25, 24


class Sample(NamedTuple):
    """Where a curve is at one time, and how it goes on; (3,) each."""

    position: Array  # m
    velocity: Array  # m/s
    acceleration: Array  # m/s^2
    jerk: Array  # m/s^3

    @staticmethod
    def rest(position: Array) -> "Sample":
        return Sample(position, *np.zeros((3, 3)))


class Limits(NamedTuple):
    speed_m_s: float
    acceleration_m_s2: float


@dataclass(frozen=True)
class Trajectory:
    times_s: Array  # (S + 1,) of the waypoints, from 0
    coefficients: Array  # (S, 8, 3) of each piece, in its time as a share of its duration, lowest power first

    @property
    def duration_s(self) -> float:
        return float(self.times_s[-1])

    def at(self, time_s: float) -> Sample:
        """Before the begin as at it, after the end at rest there."""
        if time_s >= self.duration_s:
            return Sample.rest(self.coefficients[-1].sum(0))
        piece = max(int(np.searchsorted(self.times_s, time_s, "right")) - 1, 0)
        duration_s = self.times_s[piece + 1] - self.times_s[piece]
        share = max(time_s - self.times_s[piece], 0.0) / duration_s
        scale = 1.0 / duration_s ** np.arange(ENDS)
        return Sample(*(_FALLING[:ENDS] * share ** _POWERS[:ENDS] @ self.coefficients[piece] * scale[:, None]))


def minimum_snap(waypoints: Array, times_s: Array, begin: Sample | None = None) -> Trajectory:
    """Through waypoints (W, 3) m at these times (W,) s, ascending from 0, to rest at the last.

    Args:
        begin: how it goes on at the first, its position aside; from rest if not given.
    """
    pieces, durations = len(waypoints) - 1, np.diff(times_s)
    if pieces < 1 or len(times_s) != pieces + 1 or times_s[0] != 0 or not (durations > 0).all():
        raise ValueError(f"{len(waypoints)} waypoints at {times_s} s: expected two or more, at times ascending from 0")
    if not np.isfinite(waypoints).all():
        raise ValueError(f"waypoints {waypoints.tolist()} m: expected finite ones")
    A, b, row = np.zeros((TERMS * pieces, TERMS * pieces)), np.zeros((TERMS * pieces, 3)), 0
    A[:ENDS, :TERMS], A[ENDS : 2 * ENDS, -TERMS:] = _AT_0[:ENDS], _AT_1[:ENDS]
    b[0], b[ENDS] = waypoints[0], waypoints[-1]
    if begin is not None:
        b[1:ENDS] = np.stack(begin[1:]) * (durations[0] ** np.arange(1, ENDS))[:, None]
    for k in range(pieces - 1):
        row, before, after = 2 * ENDS + TERMS * k, TERMS * k, TERMS * (k + 1)
        A[row, before:after], b[row] = _AT_1[0], waypoints[k + 1]
        A[row + 1 : row + TERMS, before:after] = _AT_1[: TERMS - 1]
        slower = (durations[k] / durations[k + 1]) ** np.arange(TERMS - 1)
        A[row + 1 : row + TERMS, after : after + TERMS] = -_AT_0[: TERMS - 1] * slower[:, None]
    return Trajectory(np.array(times_s, float), np.asarray(np.linalg.solve(A, b), np.float64).reshape(pieces, TERMS, 3))


def duration_within(begin: Sample, goal: Array, limits: Limits, least_s: float = 0.0) -> float:
    """The duration in s, a multiple of 0.1, of a way from `begin` to rest at `goal` (3,) m that keeps the limits; one
    that begins beyond them, or so that they cannot be kept, keeps them as nearly as it can. At least `least_s`."""
    distance = math.dist(begin.position, goal)
    if not math.isfinite(distance) or not (limits.speed_m_s > 0 and limits.acceleration_m_s2 > 0):
        raise ValueError(f"a way of {distance} m within {limits}: expected finite, and limits above 0")
    least = max(
        PEAK_SPEED * distance / limits.speed_m_s, (PEAK_ACCELERATION * distance / limits.acceleration_m_s2) ** 0.5
    )
    least = max(least, least_s, STEP_S)
    if not any(part.any() for part in begin[1:]):
        return _rounded(least)
    found, least_excess = least, math.inf
    for attempt in range(TRIES):
        duration_s = _rounded(least * LONGER**attempt)
        excess = _excess(minimum_snap(np.stack([begin.position, goal]), np.array([0.0, duration_s]), begin), limits)
        if excess < least_excess - 1e-3:
            found, least_excess = duration_s, excess
        if excess <= 1.0:
            break
    return _rounded(found)


def _excess(way: Trajectory, limits: Limits) -> float:
    """By which factor speed or acceleration exceeds its limit."""
    samples = [way.at(way.duration_s * k / SAMPLES) for k in range(SAMPLES)]
    speed = max(math.dist(each.velocity, (0, 0, 0)) for each in samples)
    acceleration = max(math.dist(each.acceleration, (0, 0, 0)) for each in samples)
    return max(speed / limits.speed_m_s, acceleration / limits.acceleration_m_s2)


def _rounded(duration_s: float) -> float:
    return math.ceil(duration_s / STEP_S - 1e-9) * STEP_S


# (8, 8): factor of each power (column) in each derivative (row), and the power that is left
_FALLING = np.array([[math.perm(power, k) for power in range(TERMS)] for k in range(TERMS)], float)
_POWERS = np.maximum(np.arange(TERMS)[None] - np.arange(TERMS)[:, None], 0)
_AT_0 = np.diag(_FALLING.diagonal())
_AT_1 = _FALLING
