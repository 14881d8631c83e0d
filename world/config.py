"""What can be set on the world? The experiment's [world] table: every parameter with unit and source."""

from typing import Any, Literal

import msgspec

from agent.interface.fleet import Fleet
from agent.interface.sensors import Detector, Odometry
from agent.interface.tables import BadExperiment, parse_table
from world.recorded import Flight, RecordedFlights
from world.scenario import Leg, Scenario
from world.wind import Wind


class Survey(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How roughly is it measured before the start where every odometry frame is?"""

    position_sigma_m: float = 0.2  # per axis
    yaw_sigma_rad: float = 0.1

    def __post_init__(self) -> None:
        for name, value in (("position_sigma_m", self.position_sigma_m), ("yaw_sigma_rad", self.yaw_sigma_rad)):
            if not 1e-6 <= value <= 100:
                raise ValueError(f"{name} = {value!r}: expected 1e-06 to 100")


class WorldConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    detector: Detector = Detector()
    odometry: Odometry = Odometry()  # of simulated flights; recorded ones bring their own
    survey: Survey | Literal["none"] = "none"  # nobody is told anything before the start, unless there is a survey
    start_yaw: Literal["random", "zero"] = "random"  # of simulated flights: uniform in the circle, or along the x axis
    path: tuple[Leg, ...] = ()  # a simulated flight ...
    commanded: bool = False  # simulated MAVs stand where the path's only leg says, then fly what their agents command
    wind: Wind = Wind()  # of simulated flights
    flights: tuple[Flight, ...] = ()  # ... or recorded ones, one per MAV
    flights_dir: str | None = None  # where their files are
    random_window: bool = False  # of recorded flights: each begins anywhere from its from_s on, drawn anew by each seed


def parse(table: dict[str, Any], fleet: Fleet) -> WorldConfig:
    """The [world] table of an experiment, checked so far that nothing in it can fail once the world runs.

    Raises:
        BadExperiment: unknown key, wrong type, impossible value, a path that cannot be flown or unusable recordings.
    """
    config = parse_table(WorldConfig, table, "world")
    if fleet.ticks < 1:
        raise BadExperiment(f"fleet.duration_s = {fleet.duration_s:g}: shorter than one tick at {fleet.rate_hz:g} Hz")
    if bool(config.path) == bool(config.flights):
        raise BadExperiment(
            f"world: {len(config.path)} legs of a path and {len(config.flights)} recorded flights, expected one of the "
            f"two: [[world.path]] or [[world.flights]]"
        )
    if config.random_window and not config.flights:
        raise BadExperiment("world.random_window = true: expected [[world.flights]], simulated flights have no windows")
    if config.commanded and len(config.path) != 1:
        found = f"{len(config.path)} legs of a path" if config.path else "recorded flights"
        raise BadExperiment(f"world.commanded = true: {found}, expected one leg: where the MAVs start")
    if config.wind != Wind() and not config.path:
        raise BadExperiment("world.wind: expected [[world.path]], no wind can blow on recorded flights")
    if config.path:
        Scenario(config.path, fleet, config.commanded)
    else:
        RecordedFlights(config.flights, config.flights_dir, fleet, config.random_window)
    return config
