"""One short real run in one process, for all that read recordings."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from agent.interface import messages, topics
from agent.interface.bus import Packet
from deploy.experiment import Experiment, load
from deploy.log import read_log
from deploy.recording import Recording, assemble
from deploy.run import Result, run
from deploy.terminal import Quiet

EXPERIMENT = "cold_start"
TICKS = 36  # three MAVs are localised by 1.5 s, and errors are scored from 2 s later on
SMALL = ("fleet.mavs=3", f"fleet.duration_s={TICKS / 10}", "agent.detector.P_D=0.8")


class Flown(NamedTuple):
    experiment: Experiment
    folder: Path
    result: Result


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    experiment = load(EXPERIMENT, SMALL, seed=5)
    folder = tmp_path_factory.mktemp("flown") / "run"
    return Flown(experiment, folder, run(experiment, folder, True, Quiet()))


@pytest.fixture(scope="session")
def recording(flown: Flown) -> Recording:
    return recording_of(flown.experiment, flown.folder)


def registration(mav: int, epoch: int, reasons: list[str], hypotheses: int, tick: int = 0) -> Packet:
    """A hand-made message of this agent at 10 Hz; no hypothesis says anything of anybody."""
    header = (messages.VERSION, epoch, mav, tick, tick * 10**8)
    placed = bytes(hypotheses * len(reasons))
    weights = np.full(hypotheses, 1 / max(hypotheses, 1)).tobytes()
    message = messages.Registration(*header, tuple(reasons), weights, placed, bytes(16 * len(placed)))
    return Packet(topics.key(topics.REGISTRATION, mav), messages.encode(message))


def recording_of(experiment: Experiment, folder: Path) -> Recording:
    log = read_log(folder / "log.mcap")
    return assemble(log.packets, experiment.fleet, log.origin.epoch)
