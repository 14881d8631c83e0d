"""One short real run in one process, for all that read recordings."""

from pathlib import Path
from typing import NamedTuple

import pytest

from deploy.experiment import Experiment, load
from deploy.run import Result, run
from deploy.terminal import Quiet

SMALL = ("fleet.mavs=3", "fleet.duration_s=4", "agent.detector.P_D=0.8")


class Flown(NamedTuple):
    experiment: Experiment
    folder: Path
    result: Result


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    experiment = load("line", SMALL, seed=5)
    folder = tmp_path_factory.mktemp("flown") / "run"
    return Flown(experiment, folder, run(experiment, folder, True, Quiet()))
