"""Random fault schedules, and whether a run keeps what every run has to keep: for a test and for a command."""

import random
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np

from agent.agent import Agent
from agent.estimator.history import History
from agent.interface.bus import Packet
from agent.interface.frames import Array
from agent.registration.hypotheses import WINDOW
from agent.sensing import neighbours, own
from deploy import composition, faults, summary
from deploy.clairvoyant import replay
from deploy.experiment import Experiment, load
from deploy.recording import assemble

EPOCH = 2**30
ROUNDING = 1e-9  # an eigenvalue may be negative by so much of the largest


class Broken(Exception):
    """A run has not kept what it has to keep."""


def drawn(seed: int) -> Experiment:
    """Two to four MAVs in a random box for 2 to 4 s, and whatever may go wrong."""
    rng = random.Random(seed)
    mavs, duration_s = rng.choice([2, 3, 4]), rng.choice([2.0, 3.0, 4.0])
    experiment = load("cold_start", [f"fleet.mavs={mavs}", f"fleet.duration_s={duration_s}"], seed=seed)
    return experiment._replace(faults=faults.parse(_table(rng, mavs, duration_s), experiment.fleet))


def _table(rng: random.Random, mavs: int, duration_s: float) -> dict[str, Any]:
    table = _conditions(rng) if rng.random() < 0.6 else {}
    table["links"] = [
        _conditions(rng) | {"senders": rng.sample(range(1, mavs + 1), rng.randint(1, mavs))} | _span(rng, duration_s)
        for _ in range(rng.randint(0, 2))
    ]
    if rng.random() < 0.4:
        ids = rng.sample(range(1, mavs + 1), mavs)
        cut = rng.randint(1, mavs - 1)
        kind = {"groups": [ids[:cut], ids[cut:]], "one_way": rng.random() < 0.5, "kept": rng.random() < 0.5}
        table["partitions"] = [kind | _span(rng, duration_s)]
    lives = [_life(rng, mav, round(10 * duration_s)) for mav in range(1, mavs + 1) if rng.random() < 0.4]
    table["processes"] = [event for life in lives for event in life]
    return table


def _span(rng: random.Random, duration_s: float) -> dict[str, float]:
    return {"from_s": rng.uniform(0, duration_s / 2), "until_s": rng.uniform(duration_s / 2, duration_s)}


def _conditions(rng: random.Random) -> dict[str, Any]:
    every: list[tuple[float, dict[str, list[Any]]]] = [
        (0.4, {"loss": [0.1, 0.5, 0.9]}),
        (0.2, {"burst_loss": [0.2, 0.8], "burst_s": [0.1, 0.5]}),
        (0.4, {"delay_ms": [10, 100, 300, 900]}),
        (0.3, {"jitter_ms": [5, 80, 300], "jitter": ["uniform", "lognormal"]}),
        (0.3, {"duplicates": [0.1, 1.0]}),
        (0.3, {"reorder": [0.1, 1.0]}),
        (0.2, {"bandwidth_bytes_s": [500.0, 3000.0]}),
        (0.2, {"topics": [["odometry"], ["detections"]]}),
    ]
    drawn: dict[str, Any] = {}
    for share, keys in every:
        if rng.random() < share:
            drawn |= {key: rng.choice(values) for key, values in keys.items()}
    return drawn


def _life(rng: random.Random, mav: int, ticks: int) -> list[dict[str, Any]]:
    """What happens to one process, which is not there yet in one case of five."""
    state, events = "not yet started" if rng.random() < 0.2 else "running", []
    for tick in sorted(rng.sample(range(ticks - 1), rng.randint(1, 5))):
        verb = rng.choice([verb for verb, (states, _) in faults.VERBS.items() if state in states])
        state = faults.VERBS[verb][1]
        events.append({"mav": mav, "do": verb, "at_s": tick / 10})
    return events


def fly(experiment: Experiment) -> dict[str, Any]:
    """Flies it in this process, looking at every agent after everything it does; returns the summary.

    Raises:
        Broken: a covariance that is none, a queue beyond its bound, or a wrong commit.
    """
    packets: list[Packet] = []
    with mock.patch("agent.agent.Agent", _Watched):
        composition.fly(experiment, EPOCH, packets.extend)
    recording = assemble(packets, experiment.fleet, EPOCH)
    _expect(not recording.rejected, f"packets that are no messages: {recording.rejected}")
    analysis = summary.analyse(recording, replay(recording, experiment.agent), experiment.faults)
    found = summary.summarise(analysis, summary.Circumstances("schedule", "memory", 1.0))
    wrong = [mav["wrong_commits"] for mav in found["mavs"]]
    _expect(not any(wrong), f"wrong commits by MAV: {wrong}")
    return found


class _Watched(Agent):
    def advance(self, all_here: bool = False) -> None:
        super().advance(all_here)
        history = self._localiser._history
        for Sigma in _covariances(history):
            expect_covariance(Sigma)
        lag = history._lag
        for what, size, most in (
            ("ticks of the history", len(history._ticks), lag + 1),
            ("frames of the registration", len(self._localiser._registrar._window.frames), WINDOW + lag),
            ("sets waited for", len(self._localiser._registrar._waiting._came), self._fleet.mavs * (lag + 1)),
            ("ticks of the neighbours", len(self._neighbours._ticks), neighbours.AHEAD + lag + 1),
            ("readings of its own", max(len(self._own._vio), len(self._own._sightings)), own.WAITING),
        ):
            _expect(size <= most, f"{what}: {size}, expected at most {most}")


def _covariances(history: History) -> Iterator[Array]:
    """All that are kept of the filter."""
    for kept in history._ticks:
        if kept.before is not None and kept.before.moments is not None and kept.before.state is not None:
            yield kept.before.moments.poses.Sigma
            yield kept.before.state.P
    now = None if history._now is None else history.team(history._now)
    if now is not None:
        yield now.poses.Sigma


def expect_covariance(Sigma: Array) -> None:
    """Raises Broken if this is none."""
    _expect(bool(np.isfinite(Sigma).all()), "a covariance that is not finite")
    _expect(bool(np.allclose(Sigma, Sigma.T, rtol=0, atol=ROUNDING * np.abs(Sigma).max())), "one that is not symmetric")
    eigenvalues = np.linalg.eigvalsh(Sigma)
    _expect(bool(eigenvalues[0] >= -ROUNDING * eigenvalues[-1]), f"a negative eigenvalue: {eigenvalues[0]:.3g}")


def _expect(kept: bool, otherwise: str) -> None:
    if not kept:
        raise Broken(otherwise)
