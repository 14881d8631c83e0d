"""Does an agent in real time survive whatever stops it, for however long, on a network that loses and delays?"""

import random

import numpy as np
import pytest

from agent.interface import messages as m
from tests.agent.test_agent import IMPATIENT, SCATTERED, Rig

STOPS = (1, 3, 5, 8, 12, 30, 63, 64, 65, 70, 90)  # ticks: within and beyond the lag, and what is believed of others


@pytest.mark.parametrize("seed", range(4))
def test_it_goes_on_after_every_stop(seed):
    rng, peers, ticks = random.Random(seed), (2, 3, 4), 180
    rig = Rig(seed, mavs=4, realtime=True, ticks=ticks + 1, config=IMPATIENT, places=SCATTERED)
    agent, stopped, begun = rig.agents[0], 0, dict.fromkeys(peers, 0)
    for rig.k in range(ticks):
        rig.sensors(of=[1])
        for peer in peers:
            if rng.random() < 0.02:
                begun[peer] = rig.k  # it counts anew
            if rng.random() < 0.8:
                rig.shared([peer], rig.k, since=begun[peer])
            if rig.k > 14 and rng.random() < 0.3:
                rig.shared_late([peer], rig.k - rng.randint(1, 14))
        if stopped:
            stopped -= 1
            continue
        if rng.random() < 0.06:
            stopped = rng.choice(STOPS)
        agent.advance()
    rig.k = ticks
    rig.sensors(of=[1])
    for _ in range(5):
        agent.advance()
    estimates = [estimate for _, estimate in rig.published(m.Estimate)]
    assert estimates[-1].stamp_ns == rig.fleet.stamp_ns(ticks)
    assert np.isfinite(m.floats(estimates[-1].poses)).all()
