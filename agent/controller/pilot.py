"""How does a MAV fly the mission? From its own estimate alone; its peers say what they are about to do, not what to do.

It takes off straight up by its own odometry, to a height of its own: that tells who is who where places do not. Then,
formation by formation, it waits until everybody is localised, claims the place that its own assignment gives it, says
when it will set out for it and how long it will take, and goes when everybody has: at the latest of these times, for
the longest of these durations, so that straight ways do not meet. If the estimate moves the goal, it plans anew from
where it is. Whoever loses the leader or a teammate, or never knows them, stops, says so, and lands in the end.
"""

import logging
import math

import numpy as np
from msgspec.structs import replace

from agent.controller.detour import waypoints
from agent.controller.separation import push
from agent.controller.surroundings import Surroundings
from agent.controller.team_plan import TeamPlan
from agent.controller.trajectory import Limits, Sample, Trajectory, duration_within, through
from agent.interface.frames import Array
from agent.interface.intent import (
    FORMING,
    HOLDING,
    LANDED,
    LANDING,
    LOST,
    NOWHERE,
    PHASES,
    READY,
    TAKING_OFF,
    WAITING,
    Intent,
)  # fmt: skip
from agent.interface.mission import Mission

WAIT_S = 0.5  # before take-off: a MAV that finds the others flying is in the air, too
REPLAN_S = 1.0  # at least, for a way that is planned anew
WIDER = 1.5  # times the limits are allowed to a way that is changed in mid-flight
LANDING_M_S = 0.5
NEVER_NS = 2**62
FAR_DOWN_M = 20.0  # the way to a ground of which nothing is known

log = logging.getLogger("agent")


class Pilot:
    """Of MAV `mav`."""

    def __init__(self, mission: Mission, mav: int) -> None:
        self._mission, self._mav = mission, mav
        self._limits = Limits(mission.speed_m_s, mission.acceleration_m_s2)
        self._team = TeamPlan(mission, mav)
        self._plan: Trajectory | None = None
        self._goal = np.zeros(3)  # m, in its odometry frame
        self._begun_ns = self._ends_ns = 0  # of the plan
        self._until_ns = 0  # of the phase
        self._from_ground = True  # so that this is where its odometry began
        self.intent = Intent(WAITING, 0, NOWHERE, 0, 0.0)

    def fly(self, here: Surroundings) -> Sample:
        """What to do in this tick, in its odometry frame."""
        now = here.stamp_ns
        if self._plan is None:
            self._go_to(here, here.odometry[:3], 0.0)
            self._until_ns = now + _ns(WAIT_S)
        elif self.intent.phase == READY:
            self._set_out(here)
        elif self.intent.phase in (FORMING, HOLDING):
            self._keep_to_goal(here)
        elif self.intent.phase == LOST:
            self._look_around(here)
        if now >= self._until_ns:
            self._next(here)
        wanted = self._sample(now)
        if self.intent.phase in (READY, FORMING, HOLDING, LOST):
            near = here.placed & (np.arange(len(here.poses)) != self._mav - 1)
            aside = push(here.odometry[:3], here.poses[near, :3], here.sigmas[near])
            return wanted._replace(position=wanted.position + aside)
        return wanted

    def _next(self, here: Surroundings) -> None:
        """What comes after the present phase, whose time is over."""
        phase, leg = self.intent.phase, self.intent.formation
        if phase == WAITING:
            self._take_off(here)
        elif phase == TAKING_OFF:
            self._say(READY)
        elif phase == FORMING:
            self._say(HOLDING)
            self._until_ns = here.stamp_ns + _ns(self._mission.legs[leg].hold_s)
        elif phase == HOLDING and leg + 1 < len(self._mission.legs):
            self._team.forget()
            self.intent = Intent(HOLDING, leg + 1, NOWHERE, 0, 0.0)
            self._say(READY)
        elif phase in (READY, HOLDING, LOST):
            self._land(here)
        elif phase == LANDING:
            self._say(LANDED)

    def _take_off(self, here: Surroundings) -> None:
        if any(intent.phase in (READY, FORMING, HOLDING, LOST) for intent in here.intents.values()):
            self._from_ground = False
            self._say(READY)
            return
        self._say(TAKING_OFF)
        height_m = self._mission.take_off_m + self._mission.take_off_step_m * (self._mav - 1)
        self._go_to(here, here.odometry[:3] + np.array([0.0, 0.0, height_m]), 0.0)

    def _set_out(self, here: Surroundings) -> None:
        """As soon as all are ready. At first there may be nothing to lose yet, but it is not waited for without end."""
        if not self._team.is_localised(here):
            if self.intent.formation > 0:
                self._lose(here)
            else:
                self._until_ns = min(self._until_ns, here.stamp_ns + _ns(self._mission.land_after_s))
            return
        self._until_ns = NEVER_NS
        self.intent, together = self._team.agree(here, self.intent, self._limits)
        if together is None:
            return
        goal = self._team.goal(here, self.intent)
        self._say(FORMING)
        self._go_to(here, goal, (together.until_ns - here.stamp_ns) / 1e9)

    def _keep_to_goal(self, here: Surroundings) -> None:
        """If the estimate has moved it, plan anew; if there is none, stop."""
        if not self._team.is_placed(here):
            self._lose(here)
            return
        goal = self._team.goal(here, self.intent)
        if np.linalg.norm(goal - self._goal) > self._mission.replan_beyond_m:
            due_ns, left_s = self._until_ns, (self._ends_ns - here.stamp_ns) / 1e9
            self._go_to(here, goal, max(left_s, REPLAN_S))
            self._until_ns = due_ns

    def _look_around(self, here: Surroundings) -> None:
        if self._team.is_localised(here):
            self._say(READY)

    def _lose(self, here: Surroundings) -> None:
        """Stops, and waits for the leader and the teammates to be back."""
        self._say(LOST)
        moving = self._sample(here.stamp_ns)
        speed = float(np.linalg.norm(moving.velocity))
        self._go_to(here, moving.position + moving.velocity * speed / (2 * self._limits.acceleration_m_s2), 0.0)
        self._until_ns = here.stamp_ns + _ns(self._mission.land_after_s)

    def _land(self, here: Surroundings) -> None:
        self._say(LANDING)
        at = self._sample(here.stamp_ns).position
        down = at.copy()
        frame_z = float(here.frames[self._mission.leader - 1, 2])
        down[2] = 0.0 if self._from_ground else frame_z if np.isfinite(frame_z) else at[2] - FAR_DOWN_M
        self._go_to(here, down, abs(float(at[2] - down[2])) / LANDING_M_S)

    def _go_to(self, here: Surroundings, goal: Array, least_s: float) -> None:
        now = here.stamp_ns
        begin = Sample.rest(goal) if self._plan is None else self._sample(now)
        duration_s = duration_within(begin, goal, self._limits, max(least_s, 0.0))
        if duration_s == math.inf:
            wider = Limits(*(WIDER * limit for limit in self._limits))
            duration_s = duration_within(begin, goal, wider, max(least_s, 0.0))
        if duration_s == math.inf:
            begin = Sample.rest(begin.position)
            duration_s = duration_within(begin, goal, self._limits, max(least_s, 0.0))
        points = waypoints(begin.position, goal, here.poses[here.placed & ~here.present, :3])
        self._plan = through(points, duration_s, begin, self._limits)
        self._goal, self._begun_ns, self._ends_ns = goal, now, now + _ns(self._plan.duration_s)
        self._until_ns = self._ends_ns

    def _sample(self, now_ns: int) -> Sample:
        assert self._plan is not None
        return self._plan.at((now_ns - self._begun_ns) / 1e9)

    def _say(self, phase: int) -> None:
        log.info("%s (formation %d)", PHASES[phase], self.intent.formation + 1)
        if phase == READY:
            self._until_ns = NEVER_NS  # until all are ready
        self.intent = replace(self.intent, phase=phase)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
