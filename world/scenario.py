"""Where shall every MAV be at which time? Formations, and the path that leads from one to the next."""

import math
from bisect import bisect_right
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from agent.interface.fleet import Fleet
from agent.interface.frames import Array, rotate_z
from agent.interface.tables import BadExperiment

DIAMETER_M = 0.54  # of a MAV (the paper, Sec. VI-A; mav.xml)
CLEARANCE_M = 0.6  # least distance of two MAVs' centres
LOWEST_M = 0.3  # least height above the ground, which is at z = 0
MAX_SPEED_M_S = 5.0
MAX_ACCELERATION_M_S2 = 5.0  # with a thrust of 2.2 times the weight there is room for control above this
PEAK_SPEED = 35 / 16  # of a move, in units of distance / move_s
PEAK_ACCELERATION = 84 * math.sqrt(5) / 25  # of a move, in units of distance / move_s^2

FORMATIONS = {"circle": "radius_m", "line": "length_m", "v": "length_m", "grid": "spacing_m", "points": "points"}


class Leg(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fly to a formation and stay there. In formations MAV 1 is the leftmost, MAV N the rightmost, seen along the
    heading: so the straight ways between a line and any other formation of the same heading do not cross."""

    formation: Literal["circle", "line", "v", "grid", "points"]
    radius_m: float | None = None  # circle
    length_m: float | None = None  # line (abreast): from end to end; v (open to the rear, 90 deg): of one arm
    spacing_m: float | None = None  # grid: of rows and of columns
    points: tuple[tuple[float, float, float], ...] | None = None  # points: m from the centre, one per MAV
    center: tuple[float, float, float] = (0.0, 0.0, 1.5)  # m in the world frame
    heading_rad: float = 0.0  # turns the formation about its centre
    move_s: float = 0.0  # from the leg before to here; the first leg begins here
    hold_s: float = 0.0


class Setpoints(NamedTuple):
    """What the autopilots are asked to do, in the world frame."""

    position: Array  # (N, 3) m
    velocity: Array  # (N, 3) m/s
    acceleration: Array  # (N, 3) m/s^2
    yaw: Array  # (N,) rad


class Scenario:
    """The path of every MAV: straight lines at rest at both ends, with the yaw it has at the start."""

    def __init__(self, path: tuple[Leg, ...], fleet: Fleet) -> None:
        """
        Raises:
            BadExperiment: a leg lacks its size, is too fast, too low or brings MAVs too close.
        """
        slots, starts, moves = [_slots(leg, fleet.mavs, k) for k, leg in enumerate(path)], [], []
        time_s = 0.0
        for k, leg in enumerate(path):
            _check_times(leg, k)
            _check_places(slots[k], f"world.path[{k}]")
            if k > 0:
                _check_move(slots[k - 1], slots[k], leg.move_s, f"world.path[{k}]")
            starts.append(time_s)
            moves.append(leg.move_s)
            time_s += leg.move_s + leg.hold_s
        self._begin_s, self._move_s = starts, moves
        self._from = [slots[0], *slots[:-1]]
        self._way = [there - here for here, there in zip(self._from, slots, strict=True)]

    @property
    def start(self) -> Array:
        """(N, 3) m: where the MAVs hover at time 0."""
        return self._from[0]

    def setpoints(self, time_s: float, yaw: Array) -> Setpoints:
        """What is asked of every MAV at this time; after the last leg it holds."""
        leg = max(bisect_right(self._begin_s, time_s) - 1, 0)
        start, way, move_s = self._from[leg], self._way[leg], self._move_s[leg]
        tau = min((time_s - self._begin_s[leg]) / move_s, 1.0) if move_s > 0 else 1.0
        # The polynomial of least degree whose first three derivatives vanish at both ends.
        rest = tau * (1 - tau)
        share = tau**4 * (35 - 84 * tau + 70 * tau**2 - 20 * tau**3)
        speed = 140 * rest**3 / move_s if move_s > 0 else 0.0
        acceleration = 420 * rest**2 * (1 - 2 * tau) / move_s**2 if move_s > 0 else 0.0
        return Setpoints(start + share * way, speed * way, acceleration * way, yaw)


def _slots(leg: Leg, mavs: int, index: int) -> Array:
    """(N, 3) m: the places of the formation in the world frame."""
    needed, where = FORMATIONS[leg.formation], f"world.path[{index}]"
    for name in dict.fromkeys(FORMATIONS.values()):
        given = getattr(leg, name) is not None
        if given != (name == needed):
            verb = "does not take" if given else "needs"
            raise BadExperiment(f"{where}: formation {leg.formation!r} {verb} {name}")
    if leg.points is not None:
        if len(leg.points) != mavs:
            raise BadExperiment(f"{where}.points: {len(leg.points)} points, expected {mavs}, one per MAV")
        places = np.array(leg.points, float)
    else:
        size_m = float(getattr(leg, needed))
        if not 0 < size_m <= 1000:
            raise BadExperiment(f"{where}.{needed} = {size_m:g}: expected between 0 and 1000 m")
        places = np.zeros((mavs, 3))
        places[:, :2] = _shape(leg.formation, size_m, mavs)
        # Left to right (y falls), then front to back; rounded, because sines of equal places differ in the last bit.
        places = places[np.lexsort((-places[:, 0].round(6), -places[:, 1].round(6)))]
    placed: Array = rotate_z(leg.heading_rad, places) + np.array(leg.center)
    if not np.isfinite(placed).all() or np.abs(placed).max() > 1e4:
        raise BadExperiment(f"{where}: center, points and heading_rad must be finite and within 10 km")
    return placed


def _shape(formation: str, size_m: float, mavs: int) -> Array:
    """(N, 2) m: x ahead, y left, about the centre."""
    k = np.arange(mavs)
    if formation == "circle":
        angle = 2 * np.pi * k / mavs
        return np.asarray(size_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    if formation == "line":
        sideways = size_m * ((mavs - 1) / 2 - k) / max(mavs - 1, 1)
        return np.asarray(np.stack([np.zeros(mavs), sideways], axis=-1))
    if formation == "v":
        rank, side = (k + 1) // 2, np.where(k % 2, 1.0, -1.0)  # the tip, then left and right in turn
        along = size_m / math.sqrt(2) * rank / max(mavs // 2, 1)
        return np.asarray(np.stack([along.max() / 2 - along, side * along], axis=-1))
    columns = math.ceil(math.sqrt(mavs))
    places = size_m * np.stack([-(k // columns), -(k % columns)], axis=-1).astype(float)
    return np.asarray(places - (places.max(axis=0) + places.min(axis=0)) / 2)


def _check_times(leg: Leg, index: int) -> None:
    for name in ("move_s", "hold_s"):
        if not 0 <= getattr(leg, name) <= 86400:
            raise BadExperiment(f"world.path[{index}].{name} = {getattr(leg, name):g}: expected 0 to 86400 s")
    if index == 0 and leg.move_s > 0:
        raise BadExperiment(
            f"world.path[0].move_s = {leg.move_s:g}: the first leg is where the MAVs start, leave it out"
        )


def _check_places(places: Array, where: str) -> None:
    lowest = int(places[:, 2].argmin())
    if places[lowest, 2] < LOWEST_M:
        raise BadExperiment(
            f"{where}: MAV {lowest + 1} at z = {places[lowest, 2]:.2f} m, expected at least {LOWEST_M:g} m"
        )
    _check_clearance(np.linalg.norm(places[:, None] - places[None], axis=-1), f"{where}: when there")


def _check_move(start: Array, goal: Array, move_s: float, where: str) -> None:
    """Whether the fastest MAV can fly it, and whether any two meet on the way."""
    distance = float(np.linalg.norm(goal - start, axis=-1).max())
    needed_s = max(
        PEAK_SPEED * distance / MAX_SPEED_M_S, math.sqrt(PEAK_ACCELERATION * distance / MAX_ACCELERATION_M_S2)
    )
    if move_s < needed_s:
        asked = (
            f"reaches {PEAK_SPEED * distance / move_s:.1f} m/s and {PEAK_ACCELERATION * distance / move_s**2:.1f} m/s^2"
            if move_s > 0
            else f"must move {distance:.2f} m"
        )
        raise BadExperiment(
            f"{where}.move_s = {move_s:g}: the fastest MAV {asked}, at most {MAX_SPEED_M_S:g} m/s and "
            f"{MAX_ACCELERATION_M_S2:g} m/s^2 are allowed; move_s = {math.ceil(needed_s * 10) / 10:g} would do"
        )
    # All fly the same share of their way at once, so a pair's distance vector moves on a straight line too.
    before, change = start[:, None] - start[None], (goal - start)[:, None] - (goal - start)[None]
    squared = (change**2).sum(axis=-1)
    share = np.clip(-(before * change).sum(axis=-1) / np.where(squared > 0, squared, 1), 0, 1)
    _check_clearance(np.linalg.norm(before + share[..., None] * change, axis=-1), f"{where}: on the straight way there")


def _check_clearance(distances: Array, where: str) -> None:
    apart = distances + np.diag(np.full(len(distances), np.inf))
    i, j = divmod(int(apart.argmin()), len(apart))
    if apart[i, j] < CLEARANCE_M:
        raise BadExperiment(
            f"{where} MAVs {i + 1} and {j + 1} are {apart[i, j]:.2f} m apart, expected at least {CLEARANCE_M:g} m: "
            f"a MAV is {DIAMETER_M:g} m across"
        )
