"""Do the real processes of a run, over the real network, do what the one process does, and do they all end?"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from deploy.log import read_log
from deploy.recording import Recording, assemble
from deploy.run import run
from deploy.supervisor import Outcome
from deploy.terminal import Quiet
from tests.deploy.conftest import Flown

pytestmark = pytest.mark.system
START = [sys.executable, "-m", "deploy", "run", "line", "--seed", "5"]


def recording(flown: Flown, folder: Path) -> Recording:
    log = read_log(folder / "log.mcap")
    return assemble(log.packets, flown.experiment.fleet, log.origin.epoch)


def test_processes_give_the_same_estimates_as_one_process_to_the_last_bit(flown: Flown, tmp_path: Path) -> None:
    outcome, summary = run(flown.experiment, tmp_path / "run", False, Quiet())
    assert outcome == Outcome()
    assert summary is not None
    assert (summary["transport"], summary["ticks"]) == ("zenoh", 40)
    one, many = recording(flown, flown.folder), recording(flown, tmp_path / "run")
    for name in ("truth", "odometry", "states", "estimates", "covariances", "innovations"):
        assert getattr(one, name).tobytes() == getattr(many, name).tobytes(), name
    assert sum(status.sent for status in many.statuses.values()) == len(read_log(tmp_path / "run" / "log.mcap").packets)
    logs = {path.name: path.read_text() for path in (tmp_path / "run" / "logs").iterdir()}
    assert logs == dict.fromkeys(["recorder.txt", "world.txt", "mav_1.txt", "mav_2.txt", "mav_3.txt"], "")


def launched(tmp_path: Path) -> tuple["subprocess.Popen[str]", list[psutil.Process]]:
    """A run that would last an hour, once it is on its way: the launcher and all its processes."""
    changes = ["fleet.mavs=3", "fleet.duration_s=3600"]
    words = [*START, *(word for change in changes for word in ("--set", change)), "--out", str(tmp_path / "run")]
    launcher = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert launcher.stdout is not None
    reached_s = 0.0
    while reached_s == 0:  # so far that all have met and something is recorded
        line = launcher.stdout.readline()
        assert "of 3600 s" in line
        reached_s = float(line.split()[0])
    return launcher, psutil.Process(launcher.pid).children(recursive=True)


def test_ctrl_c_writes_what_was_recorded(tmp_path: Path) -> None:
    launcher, children = launched(tmp_path)
    assert len(children) == 5
    launcher.send_signal(signal.SIGINT)
    _, said = launcher.communicate(timeout=30)
    assert launcher.returncode == 130
    assert said == f"swarm: interrupted; what was recorded is in {tmp_path / 'run'}\n"
    assert not [child for child in children if child.is_running()]
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["ticks"] > 0


def test_a_killed_agent_ends_the_run_and_is_named(tmp_path: Path) -> None:
    launcher, children = launched(tmp_path)
    (agent,) = (child for child in children if child.cmdline()[-2:] == ["--mav", "2"])
    os.kill(agent.pid, signal.SIGKILL)
    _, said = launcher.communicate(timeout=30)
    assert launcher.returncode == 1
    assert said.startswith("swarm: mav_2 ended early (killed by SIGKILL)")
    assert not [child for child in children if child.is_running()]
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["ticks"] > 0
