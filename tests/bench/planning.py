"""What does planning cost a MAV of seven? Who goes where, for how long, and its own way: `make bench`

Median and 99th percentile over random places on the ground, in ms, of one agent's whole decision: the assignment of
seven MAVs to a line of 6 m, the durations of their seven ways, and its own minimum-snap trajectory.
"""

import json
from pathlib import Path

import numpy as np

from agent.controller.surroundings import Surroundings
from agent.controller.team_plan import TeamPlan
from agent.controller.trajectory import Limits, Sample, duration_within, minimum_snap
from agent.interface import clock
from agent.interface.intent import NOWHERE, READY, Intent
from agent.interface.mission import Leg, Mission

MAVS, RUNS = 7, 300
MISSION = Mission((Leg("line", length_m=6.0),))


def surroundings(rng: np.random.Generator) -> Surroundings:
    poses = np.column_stack([rng.uniform(-2.5, 2.5, (MAVS, 2)), rng.uniform(1, 3, MAVS), rng.uniform(-3, 3, MAVS)])
    frames = poses * [1, 1, 0, 1]
    every = np.ones(MAVS, bool)
    return Surroundings(10**10, poses[0], poses, np.full(MAVS, 0.02), frames, every, every, every, {})


def main() -> None:
    rng, limits, spent_us = np.random.default_rng(0), Limits(MISSION.speed_m_s, MISSION.acceleration_m_s2), []
    for _ in range(RUNS):
        here, team = surroundings(rng), TeamPlan(MISSION, 1)
        began_us = clock.now_us()
        claim, _ = team.agree(here, Intent(READY, 0, NOWHERE, 0, 0.0), limits)
        goal, begin = team.goal(here, claim), Sample.rest(here.odometry[:3])
        duration_s = duration_within(begin, goal, limits, claim.duration_s)
        minimum_snap(np.stack([begin.position, goal]), np.array([0.0, duration_s]), begin)
        spent_us.append(clock.now_us() - began_us)
    found = {f"p{percent}_ms": round(float(np.percentile(spent_us, percent)) / 1000, 3) for percent in (50, 99)}
    print(f"a plan of {MAVS} MAVs: median {found['p50_ms']} ms, 99 % {found['p99_ms']} ms (wanted: a median of 10)")
    Path("runs").mkdir(exist_ok=True)
    Path("runs/planning.json").write_text(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
