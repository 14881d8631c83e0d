"""Who flies where, and when do all set out? What one MAV decides from its own estimate, and what the others say."""

from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from agent.controller.assignment import Mask, assigned, claimed, kept
from agent.controller.surroundings import Surroundings
from agent.controller.trajectory import Limits, Sample, duration_within
from agent.interface.frames import Array, compose, inverse
from agent.interface.intent import LANDING, LOST, NOWHERE, Intent
from agent.interface.mission import LEAST_APART_M, Mission, places

FAR_M = 1e3  # added to the distance of a place that is blocked
NOTICE_S = 1.0  # between claiming a place and setting out, for all to hear of it


class Together(NamedTuple):
    """A way that all fly at once."""

    begin_ns: int
    until_ns: int


class TeamPlan:
    """Of MAV `mav`, formation by formation."""

    def __init__(self, mission: Mission, mav: int) -> None:
        self._mission, self._mav = mission, mav
        self._about: Array | None = None  # (3,) m: what the formation is about, once all have set out

    def forget(self) -> None:
        """The next formation may be about somewhere else."""
        self._about = None

    def is_localised(self, here: Surroundings) -> bool:
        """Whether the leader is there and it and all teammates are localised: what it takes to set out."""
        return self._is_led(here) and bool(here.localised[here.present].all())

    def is_placed(self, here: Surroundings) -> bool:
        """The same, but that nobody's yaw need be known: what it takes to go on. Whoever is not heard for some seconds
        may have turned; where its odometry began, and so the formation, is known as before."""
        return self._is_led(here) and bool(here.placed[here.present].all())

    def _is_led(self, here: Surroundings) -> bool:
        leader = self._mission.leader - 1
        return bool(here.present[leader]) and bool(np.isfinite(here.frames[leader]).all())

    def goal(self, here: Surroundings, intent: Intent) -> Array:
        """(3,) m: the claimed place, in its odometry frame."""
        leader = here.frames[self._mission.leader - 1]
        goal = compose(leader, np.append(self._places(here, intent.formation)[intent.place], 0.0))[:3]
        return np.asarray(goal)

    def agree(self, here: Surroundings, intent: Intent, limits: Limits) -> tuple[Intent, Together | None]:
        """What it claims now; and when all set out, once everybody has claimed a place of his own and it is time."""
        others = {mav: said for mav, said in here.intents.items() if self._counts(here, mav, said)}
        formation = max([intent.formation, *(said.formation for said in others.values())])  # that nobody is behind
        same = {mav: said for mav, said in others.items() if said.formation == formation and said.phase != LOST}
        claims = {mav: said.place for mav, said in same.items() if said.place != NOWHERE}
        team = sorted([self._mav, *others])
        at, stand = self._positions(here, team), self._places(here, formation)
        blocked = self._blocked(here, stand)
        to, own = assigned(at, stand, blocked), team.index(self._mav)
        same_way = intent.formation == formation and intent.place != NOWHERE
        wanted = intent.place if same_way and kept(at, stand, blocked, own, intent.place) else int(to[own])
        place = claimed(wanted, np.linalg.norm(stand - at[own], axis=1) + FAR_M * blocked, claims, self._mav)
        if same_way and place == intent.place:
            claim = intent
        else:
            goals = stand[[claims.get(mav, int(p)) for mav, p in zip(team, to, strict=True)]]
            goals[own] = stand[place]
            longest_s = max(duration_within(Sample.rest(a), b, limits) for a, b in zip(at, goals, strict=True))
            start_ns = here.stamp_ns + round(NOTICE_S * 1e9)
            claim = replace(intent, formation=formation, place=place, start_ns=start_ns, duration_s=longest_s)
        unheard = set(np.flatnonzero(here.present) + 1) - {self._mav, *here.intents}
        begin_ns = max([claim.start_ns, *(said.start_ns for said in same.values())])
        if unheard or len(claims) < len(others) or place in claims.values() or here.stamp_ns < begin_ns:
            return claim, None
        self._about = self._center(here)
        longest_s = max([claim.duration_s, *(said.duration_s for said in same.values())])
        return claim, Together(begin_ns, begin_ns + round(longest_s * 1e9))

    def _counts(self, here: Surroundings, mav: int, said: Intent) -> bool:
        """Whether it is there, in the air, and flies the same mission."""
        possible = said.formation < len(self._mission.legs) and (said.place < len(here.poses) or said.place == NOWHERE)
        return bool(here.present[mav - 1]) and said.phase < LANDING and possible

    def _blocked(self, here: Surroundings, stand: Array) -> Mask:
        """(N,) where somebody hangs who is gone: its MAV stays in the air without its agent."""
        gone = np.flatnonzero(here.placed & ~here.present) + 1
        apart = np.linalg.norm(stand[:, None] - self._positions(here, gone.tolist())[None], axis=-1)
        return np.asarray((apart < LEAST_APART_M).any(axis=1))

    def _positions(self, here: Surroundings, mavs: list[int]) -> Array:
        """(n, 3) m of these, in the leader's odometry frame."""
        return _in_frame(here.frames[self._mission.leader - 1], here.poses[[mav - 1 for mav in mavs]])[:, :3]

    def _places(self, here: Surroundings, leg: int) -> Array:
        """(N, 3) m of the formation, in the leader's odometry frame."""
        return places(self._mission.legs[leg], len(here.poses)) + self._center(here)

    def _center(self, here: Surroundings) -> Array:
        """(3,) m: what the formation is about, in the leader's odometry frame; its height is 0."""
        if self._about is not None:
            return self._about
        if self._mission.about == "leader":
            return np.zeros(3)
        team = here.present & here.placed
        centroid = _in_frame(here.frames[self._mission.leader - 1], here.poses[team])[:, :3].mean(0)
        return np.array([centroid[0], centroid[1], 0.0])


def _in_frame(frame: Array, poses: Array) -> Array:
    """(n, 4) in another frame (4,), given both in one."""
    return compose(np.repeat(inverse(frame)[None], len(poses), axis=0), poses)
