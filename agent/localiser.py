"""Where is everybody, from a start of which nothing is known? The registration, the filter, and who watches over it.

`Registrar` finds out who is where; `History`, with the filter in it, keeps it up; `Watchdog` notices when it is no
longer so. Between them goes, tick by tick, the `Team`: whom the filter has. What is late concerns all three, each at
its time: registration and watchdog look at a tick when all of it is there, and at the team as it was then. Indices
count the MAVs from the station's point of view, itself first; numbers are 1..N.
"""

from typing import NamedTuple

import numpy as np

from agent.config import AgentConfig
from agent.estimator.beliefs import Beliefs
from agent.estimator.history import History
from agent.estimator.joint_update import DetectionSet
from agent.interface.fleet import Fleet
from agent.interface.frames import Array
from agent.interface.messages import LOCALISED
from agent.registration.bank import Team
from agent.registration.reasons import Situation
from agent.registration.registrar import Commit, Mask, Registrar
from agent.registration.watchdog import Watchdog


class Localised(NamedTuple):
    beliefs: Beliefs
    situation: Situation | None  # MAVs in the order of their numbers; None once everybody is localised


class Localiser:
    def __init__(self, config: AgentConfig, fleet: Fleet, station: int) -> None:
        """For the MAV `station`, 1..N."""
        self._config, self._fleet, self._station = config, fleet, station
        self._ids = [station, *(mav for mav in fleet.ids if mav != station)]  # by index
        self._index = {mav: index for index, mav in enumerate(self._ids)}
        self._rows = [mav - 1 for mav in self._ids] + [fleet.mavs]  # of bodies by number, by index
        self._history = History(config, fleet, station)
        self._registrar = Registrar(config, fleet.mavs, fleet.rate_hz)
        self._watchdog = Watchdog(self._registrar.filter, fleet.mavs, config.detector.P_D)
        self._anew: set[int] = set()  # MAVs of which it is known that they have begun anew since the last tick
        self._needed = f"{config.localised_sigma_m:g} m and {config.localised_sigma_rad:g} rad are needed"

    @property
    def station_us(self) -> int:
        """Wall time of the last tick's station updates, their mean."""
        return self._history.station_us

    def frames(self) -> Array:
        """(N, 4) x y z m, yaw rad of every odometry frame, in the station's; NaN where not known."""
        return self._history.frames()

    def start(self, frames: Array, position_sigma_m: float, yaw_sigma_rad: float) -> None:
        """Begins from a rough knowledge of all odometry frames (N, 4) instead of from none."""
        self._history.start(frames, position_sigma_m, yaw_sigma_rad)

    def late(self, tick: int, mav: int, *, odometry: Array | None = None, spherical: Array | None = None) -> None:
        """What came of a tick that is over: an odometry reading (4,), or a detection set (M, 3)."""
        seen = None if spherical is None else DetectionSet(mav, spherical)
        if self._history.late(tick, mav, odometry=odometry, seen=seen):
            self._registrar.late(tick, self._index[mav], odometry=odometry, spherical=spherical)

    def begun_anew(self, tick: int, mav: int) -> None:
        """The odometry of this MAV is another one from this tick on, as after a restart."""
        self._history.forget_odometry(mav, tick)
        self._anew.add(mav)

    def tick(self, tick: int, odometry: dict[int, Array], sets: list[DetectionSet], hurried: bool = False) -> Localised:
        """Takes in what was heard of a tick; its own odometry reading must be there.

        Args:
            tick: counted from the epoch.
            odometry: by MAV, (4,) x y z m, yaw rad in its odometry frame.
            sets: own first, then by number.
            hurried: the tick is late: what can wait is to wait.
        """
        self._history.hear(tick, odometry, sets)
        anew = sorted({*self._history.begun_anew(), *self._anew})
        self._anew.clear()
        if anew:
            self._dismiss(anew, anew)
        self._history.estimate()
        self._registrar.tick(
            tick,
            {self._index[mav]: reading for mav, reading in odometry.items()},
            {self._index[s.station]: s.spherical for s in sets},
        )
        for frame in self._registrar.advance(self._placed):
            team = self._team(frame.tick)
            wrong = [] if team is None else self._watchdog.look(team, frame)
            if wrong:
                self._dismiss([self._ids[index] for index in wrong], [])
                return self._localised()
        team = self._team(self._registrar.newest)
        commit = None if team is None else self._registrar.work_on(team, hurried)
        if commit is not None:
            self._admit(commit)
        return self._localised()

    def _dismiss(self, mavs: list[int], anew: list[int]) -> None:
        """Back to searching for these MAVs; for all, if the station itself is among them."""
        if self._station in mavs:
            self._history.begin_anew()
            self._history.estimate()
            mavs = self._ids
        else:
            self._history.dismiss(mavs, anew)
        self._watchdog.forget([self._index[mav] for mav in mavs])
        self._registrar.forget()

    @property
    def _placed(self) -> Mask:
        """(N,) by index, who is in the filter."""
        return np.array([mav in self._history.members for mav in self._ids])

    def _team(self, tick: int) -> Team | None:
        """Who was in the filter after this tick; None if that is not known any more."""
        mavs, then = self._fleet.mavs, self._history.team(tick)
        if then is None:
            return None
        y, P, placed = np.zeros((mavs + 1, 4)), np.zeros((mavs + 1, 4, mavs + 1, 4)), np.zeros(mavs, bool)
        at = [*(self._index[mav] for mav in then.members), mavs]
        y[at] = then.poses.by_body
        P[np.ix_(at, range(4), at, range(4))] = then.poses.Sigma.reshape(len(at), 4, len(at), 4)
        placed[at[:-1]] = True
        return Team(y, P[1:, :, 1:].reshape(4 * mavs, 4 * mavs), placed)

    def _admit(self, commit: Commit) -> None:
        newcomers = [self._ids[index] for index in commit.mavs]
        bodies = self._fleet.mavs + 1
        y, Sigma = np.empty((bodies, 4)), np.zeros((bodies, 4, bodies, 4))
        y[self._rows] = commit.y
        others = self._rows[1:]
        P = commit.P.reshape(bodies - 1, 4, bodies - 1, 4)
        Sigma[np.ix_(others, range(4), others, range(4))] = P
        self._history.admit(commit.tick, newcomers, y, Sigma.reshape(4 * bodies, 4 * bodies))
        self._watchdog.forget(list(commit.mavs))

    def _localised(self) -> Localised:
        beliefs = self._history.beliefs()
        if (beliefs.states == LOCALISED).all():
            return Localised(beliefs, None)
        found = self._registrar.situation(self._ids, self._placed)
        order = [self._index[mav] for mav in self._fleet.ids]
        situation = Situation(
            found.states[order],
            tuple(found.reasons[index] for index in order),
            found.weights,
            found.placed[:, order],
            found.poses[:, order],
        )
        members = [mav - 1 for mav in self._history.members]
        states, reasons = situation.states.copy(), list(situation.reasons)
        states[members] = beliefs.states[members]
        for row in members:
            if states[row] != LOCALISED:
                position, yaw = (
                    np.sqrt(beliefs.covariances[row].diagonal()[:3].max()),
                    np.sqrt(beliefs.covariances[row, 3, 3]),
                )
                known = f"known to {position:.2f} m and {yaw:.2f} rad only, {self._needed}"
                silence_s = self._history.silence_s[row]
                reasons[row] = f"not heard for {silence_s:.1f} s, {known}" if silence_s else known
        return Localised(beliefs._replace(states=states), situation._replace(reasons=tuple(reasons)))
