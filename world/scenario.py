"""Where shall every MAV be at which time? Formations, and the path that leads from one to the next."""

from bisect import bisect_right
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from agent.interface.fleet import Fleet
from agent.interface.formations import SIZES, regular, size_key
from agent.interface.frames import Array, rotate_z
from agent.interface.seeds import generator
from agent.interface.tables import BadExperiment
from world.clearance import CLEARANCE_M, LOWEST_M, STANDING_M, can_be, check_move, check_places, drawn_until
from world.random_places import box

FORMATIONS = SIZES | {"box": "size_m"}


class Leg(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fly to a formation and stay there. In formations MAV 1 is the leftmost, MAV N the rightmost, seen along the
    heading: so the straight ways between a line and any other formation of the same heading do not cross. Only points
    and a box know no such order."""

    formation: Literal["circle", "line", "v", "grid", "points", "box"]
    radius_m: float | None = None  # circle
    length_m: float | None = None  # line (abreast): from end to end; v (open to the rear, 90 deg): of one arm
    spacing_m: float | None = None  # grid: of rows and of columns
    points: tuple[tuple[float, float, float], ...] | None = None  # points: m from the centre, one per MAV
    size_m: tuple[float, float, float] | None = None  # box: along the heading, across, up; random places, 1 m apart
    center: tuple[float, float, float] = (0.0, 0.0, 1.5)  # m in the world frame
    heading_rad: float = 0.0  # turns the formation about its centre
    height_step_m: float = 0.0  # MAV k is (k - 1) times this higher than the formation says
    jitter_m: float = 0.0  # standard deviation, per axis, of every MAV's random way off its place
    move_s: float = 0.0  # from the leg before to here; the first leg begins here
    hold_s: float = 0.0


class Setpoints(NamedTuple):
    """What the autopilots are asked to do, in the world frame."""

    position: Array  # (N, 3) m
    velocity: Array  # (N, 3) m/s
    acceleration: Array  # (N, 3) m/s^2
    yaw: Array  # (N,) rad


class Scenario:
    """The path of every MAV: straight lines at rest at both ends, with the yaw it has at the start. Random places come
    from the fleet's seed, so every Scenario of one run is the same."""

    def __init__(self, path: tuple[Leg, ...], fleet: Fleet, on_ground: bool = False) -> None:
        """
        Args:
            on_ground: heights do not count, all MAVs stand.

        Raises:
            BadExperiment: a leg lacks its size, is too fast, too low, too full or brings MAVs too close.
        """
        slots, starts, moves = [_slots(leg, fleet, k, on_ground) for k, leg in enumerate(path)], [], []
        time_s = 0.0
        for k, leg in enumerate(path):
            _check_times(leg, k)
            if k > 0:
                check_move(slots[k - 1], slots[k], leg.move_s, f"world.path[{k}]")
            starts.append(time_s)
            moves.append(leg.move_s)
            time_s += leg.move_s + leg.hold_s
        self._begin_s, self._move_s = starts, moves
        self._from = [slots[0], *slots[:-1]]
        self._way = [there - here for here, there in zip(self._from, slots, strict=True)]

    @property
    def start(self) -> Array:
        """(N, 3) m: where the MAVs hover, or stand, at time 0."""
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


def _slots(leg: Leg, fleet: Fleet, index: int, on_ground: bool) -> Array:
    """(N, 3) m: everybody's place in the world frame."""
    where = f"world.path[{index}]"
    places = rotate_z(leg.heading_rad, _formation(leg, fleet, index, where, on_ground)) + np.array(leg.center)
    if not np.isfinite(places).all() or np.abs(places).max() > 1e4:
        raise BadExperiment(f"{where}: center, points and heading_rad must be finite and within 10 km")
    if not -1000 <= leg.height_step_m <= 1000:
        raise BadExperiment(f"{where}.height_step_m = {leg.height_step_m:g}: expected -1000 to 1000 m")
    places[:, 2] += leg.height_step_m * np.arange(fleet.mavs)
    if on_ground:
        places[:, 2] = STANDING_M
    check_places(places, where, STANDING_M if on_ground else LOWEST_M)
    return _jittered(places, leg.jitter_m, generator(fleet.seed, f"jitter/{index}"), where, on_ground)


def _formation(leg: Leg, fleet: Fleet, index: int, where: str, on_ground: bool) -> Array:
    """(N, 3) m: everybody's place about the centre, headed along x."""
    needed = size_key(leg, FORMATIONS, where)
    if leg.points is not None:
        if len(leg.points) != fleet.mavs:
            raise BadExperiment(f"{where}.points: {len(leg.points)} points, expected {fleet.mavs}, one per MAV")
        return np.array(leg.points, float)
    if leg.size_m is not None:
        if not all(0 < size_m <= 1000 for size_m in leg.size_m):
            raise BadExperiment(f"{where}.size_m = {list(leg.size_m)}: expected three, each between 0 and 1000 m")
        bottom_m = leg.center[2] - leg.size_m[2] / 2
        if bottom_m < LOWEST_M and not on_ground:
            raise BadExperiment(f"{where}: the box begins at z = {bottom_m:.2f} m, expected at least {LOWEST_M:g} m")
        return box(leg.size_m, fleet.mavs, generator(fleet.seed, f"box/{index}"), where, flat=on_ground)
    size_m = float(getattr(leg, needed))
    if not 0 < size_m <= 1000:
        raise BadExperiment(f"{where}.{needed} = {size_m:g}: expected between 0 and 1000 m")
    return regular(leg.formation, size_m, fleet.mavs)


def _jittered(places: Array, sigma_m: float, random: np.random.Generator, where: str, on_ground: bool) -> Array:
    """(N, 3) m: each off its place, but neither too low nor too close to another."""
    if not 0 <= sigma_m <= 1000:
        raise BadExperiment(f"{where}.jitter_m = {sigma_m:g}: expected 0 to 1000 m")
    if sigma_m == 0:
        return places
    lowest_m, sigmas_m = (STANDING_M, [sigma_m, sigma_m, 0.0]) if on_ground else (LOWEST_M, [sigma_m] * 3)
    return drawn_until(
        lambda drawn: can_be(drawn, lowest_m),
        lambda: places + sigmas_m * random.standard_normal(places.shape),
        f"{where}.jitter_m = {sigma_m:g}: MAVs always come closer than {CLEARANCE_M:g} m or lower than {lowest_m:g} m, "
        f"expected a smaller one",
    )


def _check_times(leg: Leg, index: int) -> None:
    for name in ("move_s", "hold_s"):
        if not 0 <= getattr(leg, name) <= 86400:
            raise BadExperiment(f"world.path[{index}].{name} = {getattr(leg, name):g}: expected 0 to 86400 s")
    if index == 0 and leg.move_s > 0:
        raise BadExperiment(
            f"world.path[0].move_s = {leg.move_s:g}: the first leg is where the MAVs start, leave it out"
        )
