"""Where is everybody, from a start of which nothing is known? The registration, the filter, and who watches over it.

`Registrar` finds out who is where; `Estimator` keeps it up; `Watchdog` notices when it is no longer so. Between them
goes, tick by tick, the `Team`: whom the filter has. Indices count the MAVs from the station's point of view, itself
first; numbers are 1..N.
"""

from typing import NamedTuple

import numpy as np

from agent.config import AgentConfig
from agent.estimator.estimator import Beliefs, Estimator
from agent.estimator.joint_update import DetectionSet
from agent.interface import clock
from agent.interface.fleet import Fleet
from agent.interface.frames import Array, wrap
from agent.interface.messages import LOCALISED
from agent.registration.bank import Team
from agent.registration.reasons import Situation
from agent.registration.registrar import Commit, Registrar
from agent.registration.watchdog import Watchdog

FASTEST_M_S, FASTEST_RAD_S = 15.0, 10.0  # beyond, an odometry has not flown but begun anew


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
        self._estimator = Estimator(config, fleet, station)
        self._registrar = Registrar(config, fleet.mavs, fleet.rate_hz)
        self._watchdog = Watchdog(self._registrar.filter, fleet.mavs, config.detector.P_D)
        self._needed = f"{config.localised_sigma_m:g} m and {config.localised_sigma_rad:g} rad are needed"
        self._last: dict[int, tuple[int, Array]] = {}  # by MAV: tick and reading of its odometry
        self.station_us = 0  # wall time of the last tick's station updates, their mean

    def start(self, frames: Array, position_sigma_m: float, yaw_sigma_rad: float) -> None:
        """Begins from a rough knowledge of all odometry frames (N, 4) instead of from none."""
        self._estimator.start(frames, position_sigma_m, yaw_sigma_rad)

    def late(self, tick: int, station: int, spherical: Array) -> None:
        """A detection set of a tick that is over: for the registration it is not too late."""
        self._registrar.late(tick, self._index[station], spherical)

    def tick(self, tick: int, odometry: dict[int, Array], sets: list[DetectionSet]) -> Localised:
        """Takes in what was heard of a tick; its own odometry reading must be there.

        Args:
            tick: counted from the epoch.
            odometry: by MAV, (4,) x y z m, yaw rad in its odometry frame.
            sets: own first, then by number.
        """
        self._check_jumps(tick, odometry)
        self._estimator.predict(odometry)
        began_us = clock.now_us()
        self._estimator.associate_all(sets)
        self.station_us = (clock.now_us() - began_us) // max(len(sets), 1)
        self._estimator.finish()
        frame = self._registrar.tick(
            tick,
            {self._index[mav]: reading for mav, reading in odometry.items()},
            {self._index[s.station]: s.spherical for s in sets},
        )
        team = self._team()
        wrong = self._watchdog.look(team, frame)
        if wrong:
            self._dismiss([self._ids[index] for index in wrong])
            if not self._estimator.members:  # the station itself begins anew
                self._estimator.predict(odometry)
            return self._localised()
        commit = self._registrar.work_on(team)
        if commit is not None:
            self._admit(commit, odometry)
        return self._localised()

    def _check_jumps(self, tick: int, odometry: dict[int, Array]) -> None:
        jumped = self._estimator.begun_anew(odometry)
        for mav, reading in odometry.items():
            if mav in self._last:
                before, last = self._last[mav]
                rate = self._fleet.rate_hz / max(tick - before, 1)
                speed = float(np.linalg.norm(reading[:3] - last[:3])) * rate
                if speed > FASTEST_M_S or abs(float(wrap(reading[3] - last[3]))) * rate > FASTEST_RAD_S:
                    jumped.append(mav)
            self._last[mav] = (tick, reading)
        if jumped:
            self._dismiss(jumped)

    def _dismiss(self, mavs: list[int]) -> None:
        """Back to searching for these MAVs; for all, if the station itself is among them."""
        if self._station in mavs:
            self._estimator = Estimator(self._config, self._fleet, self._station)
            mavs = self._ids
        else:
            self._estimator.dismiss([mav for mav in mavs if mav in self._estimator.members])
        self._watchdog.forget([self._index[mav] for mav in mavs])
        self._registrar.forget()

    def _team(self) -> Team:
        mavs, members = self._fleet.mavs, self._estimator.members
        y, P, placed = np.zeros((mavs + 1, 4)), np.zeros((mavs + 1, 4, mavs + 1, 4)), np.zeros(mavs, bool)
        at = [*(self._index[mav] for mav in members), mavs]
        poses = self._estimator.poses
        y[at] = poses.by_body
        P[np.ix_(at, range(4), at, range(4))] = poses.Sigma.reshape(len(at), 4, len(at), 4)
        placed[at[:-1]] = True
        return Team(y, P[1:, :, 1:].reshape(4 * mavs, 4 * mavs), placed)

    def _admit(self, commit: Commit, odometry: dict[int, Array]) -> None:
        newcomers = [mav for mav in map(self._ids.__getitem__, commit.mavs) if mav in odometry]
        if not newcomers:
            return
        bodies = self._fleet.mavs + 1
        y, Sigma = np.empty((bodies, 4)), np.zeros((bodies, 4, bodies, 4))
        y[self._rows] = commit.y
        others = self._rows[1:]
        P = commit.P.reshape(bodies - 1, 4, bodies - 1, 4)
        Sigma[np.ix_(others, range(4), others, range(4))] = P
        self._estimator.admit(newcomers, y, Sigma.reshape(4 * bodies, 4 * bodies))
        self._watchdog.forget([self._index[mav] for mav in newcomers])

    def _localised(self) -> Localised:
        beliefs = self._estimator.beliefs()
        if (beliefs.states == LOCALISED).all():
            return Localised(beliefs, None)
        found = self._registrar.situation(self._ids, self._team().placed)
        order = [self._index[mav] for mav in self._fleet.ids]
        situation = Situation(
            found.states[order],
            tuple(found.reasons[index] for index in order),
            found.weights,
            found.placed[:, order],
            found.poses[:, order],
        )
        members = [mav - 1 for mav in self._estimator.members]
        states, reasons = situation.states.copy(), list(situation.reasons)
        states[members] = beliefs.states[members]
        for row in members:
            if states[row] != LOCALISED:
                position, yaw = (
                    np.sqrt(beliefs.covariances[row].diagonal()[:3].max()),
                    np.sqrt(beliefs.covariances[row, 3, 3]),
                )
                reasons[row] = f"known to {position:.2f} m and {yaw:.2f} rad only, {self._needed}"
        return Localised(beliefs._replace(states=states), situation._replace(reasons=tuple(reasons)))
