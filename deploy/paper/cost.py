"""What does one update cost with N robots, with and without gating and hypothesis evaluation? (The paper's Fig. 2b.)

Both columns work on the same states and the same detection sets, one after the other in one process. The sets are those
with as many detections as targets. The plain column enumerates every hypothesis; at N = 9 that takes seconds, so it
gets fewer sets. Medians are quoted.
"""

import statistics
from collections.abc import Iterator
from math import comb, factorial
from typing import Any, NamedTuple

import numpy as np

from agent.config import AgentConfig
from agent.estimator.cpdaf import Rules
from agent.estimator.estimator import Estimator
from agent.estimator.gating import chi_square_quantile
from agent.estimator.moments import DetectionGeometry
from agent.estimator.state import Poses
from agent.estimator.station_update import Pairs, station_update
from agent.interface import clock
from agent.interface.frames import Array, compose, inverse, relative_pose
from deploy.composition import fly
from deploy.experiment import load
from deploy.recording import Recording, assemble
from deploy.run import EPOCHS

CONFIG = AgentConfig()
FAST = Rules(chi_square_quantile(CONFIG.filter.P_G, 3), True, CONFIG.filter.pruned_mass)
PLAIN = Rules(np.inf, False, 0.0)
SETTLED = 20  # ticks
SETS = 60
PLAIN_BUDGET_US = 8_000_000
CHANGES = (
    "fleet.duration_s=5.0",
    'world.path=[{formation="circle", radius_m=2.7, jitter_m=0.3, hold_s=5.0}]',
    "world.survey={position_sigma_m=0.2, yaw_sigma_rad=0.1}",
)


class Update(NamedTuple):
    poses: Poses
    geometry: DetectionGeometry
    pairs: Pairs
    spherical: Array


class Row(NamedTuple):
    n: int
    hypotheses: int
    fast_ms: float
    plain_ms: float | None


def rows(sizes: range) -> Iterator[Row]:
    """Of flights with so many MAVs."""
    for mavs in sizes:
        yield measure(mavs, updates(mavs), with_plain=True)


def updates(mavs: int) -> list[Update]:
    """Station updates in flight whose sets hold as many detections as there are targets."""
    experiment = load("cold_start", (*CHANGES, f"fleet.mavs={mavs}"), seed=mavs)
    packets: list[Any] = []
    fly(experiment, EPOCHS[0], packets.extend)
    recording = assemble(packets, experiment.fleet, EPOCHS[0])
    estimator = Estimator(CONFIG, experiment.fleet, station=1)
    estimator.start(_frames(recording), 0.2, 0.1)
    geometry = [DetectionGeometry(mavs + 1, station) for station in recording.fleet.ids]
    found: list[Update] = []
    for k in range(recording.ticks):
        estimator.predict(dict(zip(recording.fleet.ids, recording.odometry[k], strict=True)))
        for station in recording.fleet.ids:
            spherical = recording.detections[k, station]
            if k >= SETTLED and len(spherical) == mavs - 1:
                poses = estimator.poses
                found.append(Update(poses, geometry[station - 1], Pairs.at(poses, CONFIG.detector), spherical))
            estimator.associate(station, spherical)
        estimator.finish()
    return found[:SETS]


def _frames(recording: Recording) -> Array:
    """(N, 4) where every odometry frame truly began, in that of MAV 1."""
    origins = compose(recording.true_poses[0], inverse(recording.odometry[0]))
    return relative_pose(origins[:1], origins)


def measure(mavs: int, sets: list[Update], with_plain: bool) -> Row:
    for update in sets[:20]:
        time_us(update, FAST)
    fast = [time_us(update, FAST) for update in sets]
    plain: list[int] = []
    if with_plain:
        time_us(sets[0], PLAIN)  # fills the caches
        for update in sets:
            plain.append(time_us(update, PLAIN))
            if sum(plain) > PLAIN_BUDGET_US and len(plain) >= 3:
                break
    L = mavs - 1
    hypotheses = sum(comb(L, D) ** 2 * factorial(D) for D in range(L + 1))
    plain_ms = statistics.median(plain) / 1e3 if plain else None
    return Row(mavs, hypotheses, statistics.median(fast) / 1e3, plain_ms)


def time_us(update: Update, rules: Rules) -> int:
    began = clock.now_us()
    station_update(*update, CONFIG.detector.clutter_density, rules)
    return clock.now_us() - began
