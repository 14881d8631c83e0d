"""What can be set on an agent? The experiment's [agent] table: every parameter with unit and source."""

from typing import Any

import msgspec

from agent.interface.fleet import Fleet
from agent.interface.mission import Mission, check
from agent.interface.sensors import Detector, Odometry
from agent.interface.tables import parse_table

COASTING_SIGMA = (0.5, 0.5)  # m/s per axis and rad/s: how far a MAV may stray from its last velocity while unheard


class Filter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The CPDAF's own parameters."""

    gating: bool = True  # off: every detection is a candidate for every target (the paper's comparison)
    hypothesis_evaluation: bool = True  # off: every hypothesis is enumerated (the paper's comparison)
    P_G: float = 0.9999  # probability that a true detection falls inside its gate
    pruned_mass: float = 1e-6  # weight relative to the best hypothesis below which one is left out
    odometry_sigma_m: float = 0.001  # white noise of the odometry's position reading, beside its drift
    odometry_sigma_rad: float = 0.0005  # the same for its yaw

    def __post_init__(self) -> None:
        if not 0 < self.P_G < 1:
            raise ValueError(f"P_G = {self.P_G}: expected a probability between 0 and 1, both excluded")
        if not 0 <= self.pruned_mass < 0.1:
            raise ValueError(f"pruned_mass = {self.pruned_mass}: expected 0 to 0.1")
        for name, value, unit in (
            ("odometry_sigma_m", self.odometry_sigma_m, "m"),
            ("odometry_sigma_rad", self.odometry_sigma_rad, "rad"),
        ):
            if not 1e-6 <= value <= 1:  # finer, and the covariances lose their last digits
                raise ValueError(f"{name} = {value!r}: expected 1e-06 to 1 {unit}")


class Registration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the team is localised from an unknown start."""

    work_per_mav: float = 8_000.0  # detection-target pairs looked at per tick and MAV of the team

    def __post_init__(self) -> None:
        if not 100 <= self.work_per_mav <= 1e9:
            raise ValueError(f"work_per_mav = {self.work_per_mav}: expected 100 to 1e9 pairs")


class AgentConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    detector: Detector = Detector()  # what the estimator believes of the detector
    odometry: Odometry = Odometry()  # what it believes of every MAV's VIO drift
    filter: Filter = Filter()
    registration: Registration = Registration()
    mission: Mission | None = None  # what is flown, where the MAVs do as their agents command (world.commanded)
    localised_sigma_m: float = 0.15  # a MAV is called localised below this relative position uncertainty (any axis) ...
    localised_sigma_rad: float = 0.05  # ... and this relative yaw uncertainty
    lag_s: float = 1.0  # what comes later than this after its time is dropped; what comes sooner is applied at its time
    wait_for_peers_s: float = 0.03  # real time only: how long a tick waits for the peers' packets
    stale_after_s: float = 1.0  # a neighbour is stale when nothing was heard of it for so long (at least 3 ticks) ...
    gone_after_s: float = 3.0  # ... and gone after so long (or when its process is)
    hold_after_s: float = 1.0  # real time only: without a reading of its own sensors for so long, an agent holds

    def __post_init__(self) -> None:
        for name, value, unit in (
            ("localised_sigma_m", self.localised_sigma_m, "m"),
            ("localised_sigma_rad", self.localised_sigma_rad, "rad"),
            ("wait_for_peers_s", self.wait_for_peers_s, "s"),
            ("stale_after_s", self.stale_after_s, "s"),
            ("gone_after_s", self.gone_after_s, "s"),
            ("hold_after_s", self.hold_after_s, "s"),
        ):
            if not 0 < value < 100:
                raise ValueError(f"{name} = {value}: expected between 0 and 100 {unit}, both excluded")
        if not 0 <= self.lag_s <= 10:
            raise ValueError(f"lag_s = {self.lag_s}: expected 0 to 10 s")
        if self.gone_after_s < self.stale_after_s:
            raise ValueError(
                f"gone_after_s = {self.gone_after_s}: expected stale_after_s = {self.stale_after_s} or more"
            )

    def lag_ticks(self, rate_hz: float) -> int:
        """The lag in ticks."""
        return round(self.lag_s * rate_hz)


def parse(table: dict[str, Any], fleet: Fleet) -> AgentConfig:
    """The [agent] table of an experiment.

    Raises:
        BadExperiment: unknown key, wrong type or impossible value; a mission that cannot be flown.
    """
    config = parse_table(AgentConfig, table, "agent")
    if config.mission is not None:
        check(config.mission, fleet)
    return config
