"""Can MAVs be at these places, and fly straight from one to the next? If places are drawn: draw until they can."""

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from agent.interface.frames import Array
from agent.interface.tables import BadExperiment

DIAMETER_M = 0.54  # of a MAV (the paper, Sec. VI-A; mav.xml)
CLEARANCE_M = 0.6  # least distance of two MAVs' centres
LOWEST_M = 0.3  # least height of a MAV in flight above the ground, which is at z = 0
STANDING_M = 0.04  # height of one that stands on the ground: half that of its hull (mav.xml)
MAX_SPEED_M_S = 5.0
MAX_ACCELERATION_M_S2 = 5.0  # with a thrust of 2.2 times the weight there is room for control above this
PEAK_SPEED = 35 / 16  # of a move, in units of distance / move_s
PEAK_ACCELERATION = 84 * math.sqrt(5) / 25  # of a move, in units of distance / move_s^2
MAX_DRAWS = 1000

T = TypeVar("T")


def are_apart(places: Array, least_m: float = CLEARANCE_M) -> bool:
    """Whether all MAVs at these (N, 3) places are at least this far from each other."""
    return bool(_apart(places[:, None] - places[None]).min() >= least_m)


def can_be(places: Array, lowest_m: float = LOWEST_M) -> bool:
    """Whether MAVs may be at these (N, 3) places: what `check_places` checks."""
    return bool(places[:, 2].min() >= lowest_m) and are_apart(places)


def drawn_until(fits: Callable[[T], bool], draw: Callable[[], T], otherwise: str) -> T:
    """The first draw that fits.

    Raises:
        BadExperiment: none of MAX_DRAWS does; `otherwise` names the key, its value and what was expected.
    """
    for _ in range(MAX_DRAWS):
        drawn = draw()
        if fits(drawn):
            return drawn
    raise BadExperiment(f"{otherwise} (in {MAX_DRAWS} draws)")


def check_places(places: Array, where: str, lowest_m: float = LOWEST_M) -> None:
    """
    Raises:
        BadExperiment: at these (N, 3) places some MAV is too low or two are too close.
    """
    lowest = int(places[:, 2].argmin())
    if places[lowest, 2] < lowest_m:
        raise BadExperiment(
            f"{where}: MAV {lowest + 1} at z = {places[lowest, 2]:.2f} m, expected at least {lowest_m:g} m"
        )
    _check_apart(places[:, None] - places[None], f"{where}: when there")


def check_move(start: Array, goal: Array, move_s: float, where: str) -> None:
    """Whether the fastest MAV can fly from (N, 3) places to others, and whether any two meet on the way.

    Raises:
        BadExperiment: it cannot, or they do.
    """
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
    _check_apart(before + share[..., None] * change, f"{where}: on the straight way there")


def _check_apart(vectors: Array, where: str) -> None:
    apart = _apart(vectors)
    i, j = divmod(int(apart.argmin()), len(apart))
    if apart[i, j] < CLEARANCE_M:
        raise BadExperiment(
            f"{where} MAVs {i + 1} and {j + 1} are {apart[i, j]:.2f} m apart, expected at least {CLEARANCE_M:g} m: "
            f"a MAV is {DIAMETER_M:g} m across"
        )


def _apart(vectors: Array) -> Array:
    """(N, N) m from the (N, N, 3) vectors between MAVs; infinite between a MAV and itself."""
    return np.asarray(np.linalg.norm(vectors, axis=-1) + np.diag(np.full(len(vectors), np.inf)))
