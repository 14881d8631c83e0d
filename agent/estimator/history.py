"""What if data comes late, in part or never? The last ticks, kept so that each is estimated from all of its data.

Every tick of the last `lag_s` is kept with what was heard of it and with the estimator as it was before. When something
arrives for a tick that is over, the estimator goes back to there and does that tick and all after it again. If nothing
is late, that is one tick, done once.

A reading that is missing is made good by the next one (poses are sent, not increments): it is interpolated. As long as
there is no next one, its MAV is carried forward, as uncertain as that makes it. Detection sets do not wait for it: what
they say of now is worth more than what waiting would add, and they are done again when the reading comes.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.estimator.beliefs import NOTHING, Beliefs, Counts
from agent.estimator.estimator import Estimator, Snapshot
from agent.estimator.joint_update import DetectionSet
from agent.estimator.readings import Readings
from agent.estimator.state import Poses
from agent.interface import clock
from agent.interface.fleet import Fleet
from agent.interface.frames import Array

LONGEST_GAP_S = 30.0  # without any tick, after which nothing is left of what was believed

Index = npt.NDArray[np.intp]


class Admission(NamedTuple):
    """Who is taken in at the end of a tick; see `Estimator.admit`."""

    newcomers: list[int]
    y: Array
    Sigma: Array


class _Given(NamedTuple):
    """What one tick is estimated from."""

    z: Array  # (N, 4) with what is interpolated; NaN where there is neither
    between: Index  # (N,) of interpolated readings: ticks between the two they lie between, else 0
    sets: list[int]  # stations whose set is used

    def same(self, other: "_Given | None") -> bool:
        return (
            other is not None
            and self.sets == other.sets
            and np.array_equal(self.between, other.between)
            and np.array_equal(self.z, other.z, equal_nan=True)
        )


@dataclass
class _Tick:
    number: int
    sets: dict[int, DetectionSet] = field(default_factory=dict)  # by station
    admissions: list[Admission] = field(default_factory=list)
    before: Snapshot | None = None  # of the estimator
    given: _Given | None = None  # when it was last estimated
    counts: Counts = NOTHING  # then


class Team(NamedTuple):
    """Who is in the filter, and where."""

    members: list[int]
    poses: Poses  # theirs, then that of the start


class History:
    """The estimator of MAV `station`, 1..N, and its last ticks."""

    def __init__(self, config: AgentConfig, fleet: Fleet, station: int) -> None:
        self._config, self._fleet, self._station = config, fleet, station
        self._lag = config.lag_ticks(fleet.rate_hz)
        self._longest_gap = max(self._lag, round(LONGEST_GAP_S * fleet.rate_hz))
        self._estimator = Estimator(config, fleet, station)
        self._ticks: list[_Tick] = []  # oldest first, without gaps
        self._now: int | None = None
        self._readings = Readings(fleet.mavs, self._lag)
        self._revised = False  # whether something came for a tick that is over, since the last `estimate`
        self._stations = [station, *(mav for mav in fleet.ids if mav != station)]  # in the order of their updates
        self._counts = NOTHING
        self.station_us = 0  # wall time of the last tick's station updates, their mean

    def start(self, frames: Array, position_sigma_m: float, yaw_sigma_rad: float) -> None:
        """Begins from a rough knowledge of all odometry frames (N, 4) instead of from none."""
        self._estimator.start(frames, position_sigma_m, yaw_sigma_rad)
        self._ticks.clear()

    def late(self, tick: int, mav: int, *, odometry: Array | None = None, seen: DetectionSet | None = None) -> bool:
        """Takes in what came too late for its tick; False if it is of no use any more."""
        kept = self._at(tick)
        if kept is None or self._now is None or tick <= self._now - self._lag:
            return False  # when the next tick is there, it will be out of reach
        if not self._readings.belongs(tick, mav):
            return False
        self._revised = True
        if odometry is not None:
            self._readings.put(tick, mav, odometry)
        if seen is not None:
            kept.sets.setdefault(mav, seen)
        return True

    def hear(self, tick: int, odometry: dict[int, Array], sets: list[DetectionSet]) -> None:
        """Takes in what came in time for the next tick, its own odometry reading included."""
        self._open(tick)
        for mav, reading in odometry.items():
            self._readings.put(tick, mav, reading)
        self._ticks[-1].sets = {one.station: one for one in sets}

    def _open(self, tick: int) -> None:
        """Begins the record of a tick, and of those that were missed since the last."""
        assert self._now is None or tick > self._now, "a tick that is over"
        missed = 0 if self._now is None else tick - self._now - 1
        if missed > self._longest_gap:
            self._estimator = Estimator(self._config, self._fleet, self._station)
        if missed > self._lag:
            self._ticks.clear()
            for _ in range(missed - self._lag if missed <= self._longest_gap else 0):
                self._estimator.predict({})
        kept = min(missed, self._lag)
        self._ticks += [_Tick(number) for number in range(tick - kept, tick + 1)]
        del self._ticks[: -self._lag - 1]
        self._readings.advance(tick, missed + 1)
        self._now = tick

    def _at(self, tick: int) -> _Tick | None:
        index = tick - self._ticks[0].number if self._ticks else -1
        return self._ticks[index] if 0 <= index < len(self._ticks) else None

    def begun_anew(self) -> list[int]:
        """MAVs of which a reading came that is not of the same odometry as those before; between `hear` and
        `estimate`."""
        first = self._ticks[0]
        then = first.before.motion if first.before is not None else self._estimator.motion
        return self._readings.begun_anew(first.number, then, self._estimator.motion.velocities[-1])

    def forget_odometry(self, mav: int, tick: int) -> None:
        """Of before this tick: there it began anew."""
        if self._now is not None:
            self._readings.forget(mav, tick)

    def estimate(self) -> None:
        """Brings the belief up to now, with all that has come."""
        newest = len(self._ticks) - 1
        if newest > 0 and not self._revised and self._readings.whole(newest + 1):  # what was done of the others stands
            then, nowhere = self._ticks[-1], np.zeros(self._fleet.mavs, np.intp)
            then.given = _Given(self._readings.newest.copy(), nowhere, self._used(then))
            first = newest
        else:
            planned, first = self._plan(), 0
            while first < newest and planned[first].same(self._ticks[first].given):
                first += 1
            for kept, given in zip(self._ticks[first:], planned[first:], strict=True):
                kept.given = given
        self._readings.read()
        self._revised = False
        self._run(first)

    def _plan(self) -> list[_Given]:
        """What each of the ticks is to be estimated from."""
        z, between = self._readings.completed(len(self._ticks))
        return [
            _Given(z_then, between_then, self._used(then))
            for then, z_then, between_then in zip(self._ticks, z, between, strict=True)
        ]

    def _used(self, tick: _Tick) -> list[int]:
        return [mav for mav in self._stations if mav in tick.sets]

    def _run(self, first: int) -> None:
        """Estimates these ticks, from this one on to the newest."""
        estimator, ticks = self._estimator, self._ticks[first:]
        if ticks[0].before is not None:
            estimator.restore(ticks[0].before)
        innovations = inside = sets = spent_us = 0
        lost = 0.0
        for kept in ticks:
            given = kept.given
            assert given is not None, "a tick that was never planned"
            kept.before = estimator.snapshot()
            estimator.predict_from(given.z, given.between)
            began_us = clock.now_us()
            estimator.associate_all([kept.sets[station] for station in given.sets])
            spent_us, sets = spent_us + clock.now_us() - began_us, sets + len(given.sets)
            estimator.lift()
            for admission in kept.admissions:
                estimator.admit(*admission)
            # An innovation counts when it is first used.
            counts, before = estimator.counts, kept.counts
            innovations += max(counts.innovations - before.innovations, 0)
            inside += max(counts.inside - before.inside, 0)
            lost = max(lost, counts.lost_mass)
            kept.counts = counts
        self.station_us = spent_us // max(sets, 1)
        self._counts = Counts(innovations, inside, lost)

    def beliefs(self) -> Beliefs:
        """What is believed now."""
        innovations, inside, lost = self._counts
        found = self._estimator.beliefs()
        return found._replace(innovations=innovations, innovations_inside=inside, lost_mass=lost)

    def frames(self) -> Array:
        """(N, 4) of every odometry frame, in that of the station; NaN where not known."""
        return self._estimator.frames()

    @property
    def members(self) -> list[int]:
        """Who is in the filter: MAV numbers, ascending."""
        return self._estimator.members

    @property
    def silence_s(self) -> Array:
        """(N,) since the last odometry reading of each MAV that is silent (`Motion.silent`), 0 for the others."""
        motion = self._estimator.motion
        return np.where(motion.silent, motion.unheard, 0)[:-1] / self._fleet.rate_hz

    def team(self, tick: int) -> Team | None:
        """Who was in the filter after this tick, and where; None if that is not known any more."""
        if tick == self._now:
            then = self._estimator.snapshot()
        else:
            later = self._at(tick + 1)
            if later is None or later.before is None:
                return None
            then = later.before
        return None if then.moments is None else Team(then.members, then.moments.poses)

    def admit(self, tick: int, newcomers: list[int], y: Array, Sigma: Array) -> None:
        """Takes in MAVs at the end of a tick that is kept, as `Estimator.admit` does; what came since is done again.

        Those of which that tick knows no reading are left out.
        """
        kept = self._at(tick)
        if kept is None or kept.given is None:
            return
        read = [mav for mav in newcomers if np.isfinite(kept.given.z[mav - 1, 3])]
        if not read:
            return
        admission = Admission(read, y, Sigma)
        kept.admissions.append(admission)
        if tick == self._now:
            self._estimator.admit(*admission)
            return
        index = tick - self._ticks[0].number + 1
        before = self._ticks[index].before
        assert before is not None
        self._estimator.restore(before)
        self._estimator.admit(*admission)
        self._ticks[index].before = self._estimator.snapshot()
        for later, given in zip(self._ticks[index:], self._plan()[index:], strict=True):
            later.given = given
        self._run(index)

    def dismiss(self, mavs: list[int], anew: list[int]) -> None:
        """Forgets these MAVs, in all that is kept: late data of the others is still good for the others. The station
        itself is not one of them.

        Args:
            mavs: who is no longer a member.
            anew: who of them was found by `begun_anew`.
        """
        now = self._estimator.snapshot()
        for kept in self._ticks:
            left = [[mav for mav in one.newcomers if mav not in mavs] for one in kept.admissions]
            kept.admissions = [
                one._replace(newcomers=some) for one, some in zip(kept.admissions, left, strict=True) if some
            ]
            if kept.before is not None:
                kept.before = self._without(kept.before, mavs, anew)
        self._estimator.restore(self._without(now, mavs, anew))

    def _without(self, then: Snapshot, mavs: list[int], anew: list[int]) -> Snapshot:
        self._estimator.restore(then)
        gone = [mav for mav in mavs if mav in self._estimator.members]
        if gone:
            self._estimator.dismiss(gone)
        if anew:
            self._estimator.lose_track(anew)
        return self._estimator.snapshot()

    def begin_anew(self) -> None:
        """Forgets everybody and all that was before the newest tick, as when the station's own odometry has begun
        anew."""
        self._estimator = Estimator(self._config, self._fleet, self._station)
        newest = self._ticks[-1]
        self._ticks = [_Tick(newest.number, newest.sets)]
        self._readings.forget_all()
