"""Does a hypothesis know how wrong it is?"""

from itertools import pairwise

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.interface.frames import wrap
from agent.interface.sensors import Odometry
from agent.registration.bank import Filter, begin
from agent.registration.proposals import propose
from agent.registration.window import Window
from tests import team
from tests.agent.registration.beginning import (
    CONSISTENT,
    SEEDS,
    alone,
    bank_at,
    box,
    finished,
    heard,
    placement,
    true_poses,
    wandering,
    window_of,
)
from tests.agent.registration.test_bank import RATE_HZ


def nees(seed, odometry=None, mavs=4, ticks=20):
    """Of a hypothesis that a generator's pose began, per dimension."""
    believed = AgentConfig(odometry=odometry or Odometry())
    flown = wandering([10, seed], mavs, ticks)
    early = window_of(flown[:8])
    reading = heard(flown[7])[0]
    station = alone(reading[0], mavs)
    base = placement(true_poses(flown[7]), np.arange(mavs) == 0)
    first = finished(propose(AgentConfig(), early.frames, base, list(range(1, mavs)), 8))[0].placements[0]
    window = window_of(flown)
    bank = begin([first], station, window.frames[7], window.frames[0])
    sight = Filter(believed, mavs, RATE_HZ)
    sight.update(bank, window.frames[0], 3)
    for before, frame in pairwise(window.frames):
        sight.step(bank, before, frame)
    error = bank.y[0, 1:mavs] - true_poses(flown[-1])[1:]
    error[:, 3] = wrap(error[:, 3])
    n = 4 * (mavs - 1)
    return error.ravel() @ np.linalg.solve(bank.P[0, :n, :n], error.ravel()) / n


@pytest.mark.statistical
def test_it_is_consistent_where_a_generator_began_it():
    assert CONSISTENT[0] < np.mean([nees(seed) for seed in range(SEEDS)]) < CONSISTENT[1]


@pytest.mark.statistical
def test_who_believes_half_the_drift_is_outside_the_band():
    half = Odometry(position_sigma_m=0.005, yaw_sigma_rad=0.001)
    assert np.mean([nees(seed, half) for seed in range(SEEDS)]) > CONSISTENT[1]


@pytest.mark.parametrize("seed", range(5))
def test_who_has_flown_on_unheard_is_not_moved_twice_when_heard_again(seed):
    """Once by what is seen of it, and once by the reading that makes up for the silence."""
    mavs, silent, ticks = 5, 3, 40
    rng = np.random.default_rng([20, seed])
    places, way = box(rng, mavs), np.zeros((mavs, 3))
    way[silent] = rng.uniform(0.3, 0.5, 3)  # m/s
    flown = list(team.fly(rng, mavs, ticks, lambda t: places + way * max(t - 0.5, 0)))
    window, sight, bank = Window(mavs, ticks), Filter(AgentConfig(), mavs, RATE_HZ), bank_at(true_poses(flown[0])[None])
    for k, tick in enumerate(flown):
        odometry, sets = heard(tick)
        unheard = 3 < k < 30
        frame = window.add(k, {i: z for i, z in odometry.items() if not (unheard and i == silent)})
        for i, spherical in sets.items():
            if not (unheard and i == silent):
                frame.put(i, spherical)
        window.settle(frame)
        if k > 0:
            sight.step(bank, window.frames[k - 1], frame)
        if k >= 30:
            assert np.linalg.norm(bank.y[0, silent, :3] - true_poses(tick)[silent, :3]) < 0.25
