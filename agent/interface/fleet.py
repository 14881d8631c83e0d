"""What must every program of one run agree on? The experiment's [fleet] table."""

import msgspec


class Fleet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    mavs: int = 7  # N; MAVs are numbered 1..N
    seed: int = 0  # every random generator of the run is a named child of it
    rate_hz: float = 10.0  # odometry, detection and estimation rate
    duration_s: float = 48.0  # simulated
    realtime: bool = False  # paced by the wall clock and waiting for nobody, instead of in lockstep

    def __post_init__(self) -> None:
        if not 1 <= self.mavs <= 50:
            raise ValueError(f"mavs = {self.mavs}: expected 1 to 50")
        if self.seed < 0:
            raise ValueError(f"seed = {self.seed}: expected 0 or more")
        if not 0.1 <= self.rate_hz <= 200:
            raise ValueError(f"rate_hz = {self.rate_hz}: expected 0.1 to 200 Hz")
        if not 0 < self.duration_s <= 86400:
            raise ValueError(f"duration_s = {self.duration_s}: expected 0 to 86400 s")

    @property
    def ids(self) -> range:
        return range(1, self.mavs + 1)

    @property
    def ticks(self) -> int:
        return round(self.duration_s * self.rate_hz)

    def stamp_ns(self, tick: int) -> int:
        """Simulated time of tick 0, 1, ... in ns."""
        return round(tick * 1e9 / self.rate_hz)
