"""What is a MAV about to do? It goes with its odometry to its peers; nobody has to obey."""

import msgspec

WAITING, TAKING_OFF, READY, FORMING, HOLDING, LOST, LANDING, LANDED = range(8)
PHASES = ("waiting", "taking off", "ready", "on the way to", "in formation", "lost", "landing", "landed")
NOWHERE = 255  # no place is claimed


class Intent(msgspec.Struct, array_like=True, frozen=True, gc=False, forbid_unknown_fields=True):
    phase: int  # index into PHASES
    formation: int  # of the mission, from 0: that it is in or on the way to, or ready for
    place: int  # that it claims there, from 0; or NOWHERE
    start_ns: int  # when it can set out for it
    duration_s: float  # how long the longest way of the team takes, as it sees it

    def __post_init__(self) -> None:
        for name, value, end in (("phase", self.phase, len(PHASES)), ("formation", self.formation, 2**16)):
            if not 0 <= value < end:
                raise ValueError(f"intent: {name} = {value}, expected 0 to {end - 1}")
        if not 0 <= self.place <= NOWHERE or not abs(self.start_ns) < 2**62 or not 0 <= self.duration_s < 1e5:
            raise ValueError(f"intent: place {self.place}, start {self.start_ns} ns or duration {self.duration_s} s")
