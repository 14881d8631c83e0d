"""On a bad network too the filter knows how wrong it is, and is little worse than one that is told who is who."""

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.estimator.history import History
from agent.estimator.motion import Motion
from agent.interface.fleet import Fleet
from tests import links, team

STATION = 2


def surveyed(ticks):
    history = History(AgentConfig(), Fleet(mavs=len(ticks[0].truth)), STATION)
    history.start(team.frames_in(ticks[0].truth, STATION), 0.2, 0.1)
    return history


def anees(seeds, ticks=110, mavs=5, after=30, path=team.circling, seen=links.untold, **network):
    """Mean NEES per dimension over runs, and the RMS position error."""
    nees, rms = [], []
    for seed in range(seeds):
        flight = list(path(np.random.default_rng([9, seed]), mavs, ticks))
        arrived = links.faulty(np.random.default_rng([10, seed]), flight, STATION, **network)
        found = links.off(flight, list(links.fly(surveyed(flight), flight, arrived, STATION, seen)), STATION)
        late = links.Off(found.errors[after:], found.covariances[after:])
        nees.append(late.nees().mean())
        rms.append(late.rms_m())
    return float(np.mean(nees)), float(np.sqrt(np.mean(np.square(rms))))


def hovering(rng, mavs, ticks):
    places = rng.uniform(-2, 2, (mavs, 3)) + 2 * np.arange(mavs)[:, None] * [1, 0, 0]
    return team.fly(rng, mavs, ticks, lambda t: places)


RUNS = 6
BAND = (0.72, 1.30)  # two-sided 95 % of chi-square with 6 runs x 16 dimensions, per dimension: 0.74 .. 1.30
NETWORKS = pytest.mark.parametrize(
    "network",
    [{"loss": 0.3}, {"delay": 3}, {"delay": 5}, {"loss": 0.3, "delay": 2, "jitter": 1}, {"loss": 0.5, "burst": 10}],
    ids=["a third lost", "300 ms late", "500 ms late", "lost and late", "lost in bursts"],
)


@pytest.mark.statistical
@NETWORKS
@pytest.mark.parametrize("path", [team.circling, hovering])
def test_it_knows_how_wrong_it_is(network, path):
    assert BAND[0] < anees(RUNS, path=path, **network)[0] < BAND[1]


@pytest.mark.statistical
@pytest.mark.parametrize(("network", "too_small"), [({"delay": 5}, 25), ({"loss": 0.5, "burst": 10}, 100)])
def test_one_that_believes_in_its_guesses_is_outside_the_band(network, too_small, monkeypatch):
    growth = Motion._growth
    monkeypatch.setattr(Motion, "_growth", lambda *arguments: growth(*arguments) / too_small)
    assert anees(RUNS, **network)[0] > BAND[1]


@pytest.mark.statistical
@pytest.mark.parametrize("network", [{"delay": 5}, {"loss": 0.3, "delay": 2, "jitter": 1}])
def test_being_told_who_is_who_helps_little(network):
    ours, told = (anees(4, ticks=70, seen=seen, **network)[1] for seen in (links.untold, links.told))
    assert ours < 1.15 * told


@pytest.mark.statistical
def test_what_is_late_is_still_worth_something():
    """The more of it, the less late: at once, after 0.3 s, after 0.5 s, never."""
    errors = [anees(3, ticks=70, delay=delay)[1] for delay in (0, 3, 5)]
    errors.append(anees(3, ticks=70, loss=1 - 1e-9)[1])
    assert errors == sorted(errors)
