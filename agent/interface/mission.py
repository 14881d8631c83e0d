"""What shall the team fly? A sequence of formations: every agent reads it in the experiment, none commands another."""

from typing import Literal

import msgspec
import numpy as np

from agent.interface.fleet import Fleet
from agent.interface.formations import SIZES, Formation, regular, size_key
from agent.interface.frames import Array, rotate_z
from agent.interface.tables import BadExperiment

LEAST_APART_M = 0.92  # of two places: straight ways of equal duration then keep 0.65 m (see `assignment.py`)
LOWEST_M = 0.5  # of a place, above where the leader's odometry began


class Leg(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fly to a formation and stay there."""

    formation: Formation
    radius_m: float | None = None  # circle
    length_m: float | None = None  # line (abreast): from end to end; v (open to the rear, 90 deg): of one arm
    spacing_m: float | None = None  # grid: of rows and of columns
    points: tuple[tuple[float, float, float], ...] | None = None  # points: m from the centre, one per MAV
    center: tuple[float, float, float] = (0.0, 0.0, 1.5)  # m: from what it is about; the height in the leader's frame
    heading_rad: float = 0.0  # in the leader's odometry frame; turns the formation about its centre
    hold_s: float = 5.0


class Mission(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    legs: tuple[Leg, ...]
    leader: int = 1  # the MAV in whose odometry frame the formations stand
    about: Literal["centroid", "leader"] = (
        "centroid"  # of the team as it sets out; or where the leader's odometry began
    )
    take_off_m: float = 1.0  # the height that MAV 1 takes off to
    take_off_step_m: float = 0.25  # by which each further MAV goes higher: it tells who is who where places do not
    speed_m_s: float = 1.0  # at most
    acceleration_m_s2: float = 1.0  # at most
    replan_beyond_m: float = 0.05  # by which the estimate must move the goal to be planned for anew; inf: planned once
    land_after_s: float = 10.0  # for which the leader or a teammate is not localised

    def __post_init__(self) -> None:
        for name, value, least, most, unit in (
            ("take_off_m", self.take_off_m, LOWEST_M, 100.0, "m"),
            ("take_off_step_m", self.take_off_step_m, 0.0, 10.0, "m"),
            ("speed_m_s", self.speed_m_s, 0.05, 5.0, "m/s"),
            ("acceleration_m_s2", self.acceleration_m_s2, 0.05, 5.0, "m/s^2"),
            ("replan_beyond_m", self.replan_beyond_m, 0.001, np.inf, "m"),
            ("land_after_s", self.land_after_s, 0.0, 1e6, "s"),
        ):
            if not least <= value <= most:
                raise ValueError(f"{name} = {value:g}: expected {least:g} to {most:g} {unit}")


def places(leg: Leg, mavs: int) -> Array:
    """(N, 3) m: the formation's places about its centre, in the leader's axes; the height is that in its frame."""
    size: float = getattr(leg, SIZES[leg.formation])
    shape = np.array(leg.points, float) if leg.points is not None else regular(leg.formation, size, mavs)
    return np.asarray(rotate_z(leg.heading_rad, shape) + np.array(leg.center))


def check(mission: Mission, fleet: Fleet) -> None:
    """
    Raises:
        BadExperiment: no legs, a leader that is no MAV, a leg without its size, places too close or too low.
    """
    if not mission.legs:
        raise BadExperiment("agent.mission.legs: none, expected one or more")
    if mission.leader not in fleet.ids:
        raise BadExperiment(f"agent.mission.leader = {mission.leader}: expected a MAV, 1 to {fleet.mavs}")
    for k, leg in enumerate(mission.legs):
        _check_leg(leg, fleet.mavs, f"agent.mission.legs[{k}]")


def _check_leg(leg: Leg, mavs: int, where: str) -> None:
    needed = size_key(leg, SIZES, where)
    if leg.points is None and not 0 < getattr(leg, needed) <= 1000:
        raise BadExperiment(f"{where}.{needed} = {getattr(leg, needed):g}: expected between 0 and 1000 m")
    if leg.points is not None and len(leg.points) != mavs:
        raise BadExperiment(f"{where}.points: {len(leg.points)} points, expected {mavs}, one per MAV")
    if not 0 <= leg.hold_s <= 86400:
        raise BadExperiment(f"{where}.hold_s = {leg.hold_s:g}: expected 0 to 86400 s")
    stand = places(leg, mavs)
    if not np.isfinite(stand).all() or np.abs(stand).max() > 1e4:
        raise BadExperiment(f"{where}: center, points and heading_rad must be finite and within 10 km")
    if stand[:, 2].min() < LOWEST_M:
        raise BadExperiment(f"{where}: a place at {stand[:, 2].min():.2f} m, expected at least {LOWEST_M:g} m")
    apart = np.linalg.norm(stand[:, None] - stand[None], axis=-1) + np.diag(np.full(mavs, np.inf))
    if apart.min() < LEAST_APART_M:
        raise BadExperiment(f"{where}: places {apart.min():.2f} m apart, expected at least {LEAST_APART_M:g} m")
