"""Do the real processes of a run, over the real network, do what the one process does, and do they all end?"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from deploy import terminal
from deploy.__main__ import main
from deploy.experiment import load
from deploy.log import read_log
from deploy.progress import Progress
from deploy.recording import Recording
from deploy.run import run
from deploy.supervisor import Outcome
from deploy.terminal import Quiet
from tests.deploy.conftest import TICKS, Flown, recording_of

pytestmark = pytest.mark.system


def test_processes_give_the_same_estimates_as_one_process_to_the_last_bit(
    flown: Flown, recording: Recording, tmp_path: Path
) -> None:
    """From an unknown start, until everybody has localised everybody and beyond."""
    outcome, summary = run(flown.experiment, tmp_path / "run", False, Quiet())
    assert outcome == Outcome()
    assert summary is not None
    assert (summary["transport"], summary["ticks"]) == ("zenoh", TICKS)
    many = recording_of(flown.experiment, tmp_path / "run")
    for name in ("truth", "odometry", "covariances", "innovations"):
        assert getattr(recording, name).tobytes() == getattr(many, name).tobytes(), name
    for name in many.beliefs._fields:
        assert getattr(recording.beliefs, name).tobytes() == getattr(many.beliefs, name).tobytes(), name
    assert sum(status.sent for status in many.statuses.values()) == len(read_log(tmp_path / "run" / "log.mcap").packets)
    assert [mav["state"] for mav in summary["mavs"]] == ["localised"] * 3
    ticks_to_register = [{mav: last.seq for mav, last in each.registrations.items()} for each in (recording, many)]
    assert ticks_to_register[0] == ticks_to_register[1] != {}
    logs = {path.name: path.read_text() for path in (tmp_path / "run" / "logs").iterdir()}
    assert logs == dict.fromkeys(["recorder.txt", "world.txt", "mav_1.txt", "mav_2.txt", "mav_3.txt"], "")


BAD_LINKS = ("faults.loss=0.2", "faults.delay_ms=60", "faults.jitter_ms=80", "faults.duplicates=0.1")


def test_faults_on_the_links_are_the_same_over_the_network_and_in_one_process(tmp_path: Path) -> None:
    """Loss, late and overtaking packets, duplicates, and a limit to what a link carries."""
    changes = ["fleet.mavs=3", "fleet.duration_s=3", *BAD_LINKS, "faults.bandwidth_bytes_s=4000"]
    experiment = load("cold_start", changes, seed=5)
    found = []
    for in_process in (True, False):
        folder = tmp_path / f"in_process_{in_process}"
        outcome, summary = run(experiment, folder, in_process, Quiet())
        assert outcome == Outcome()
        assert summary is not None
        assert summary["network"]["dropped_by_faults"] > 50
        found.append(recording_of(experiment, folder))
    one, many = found
    assert len(one.arrivals) == 3 * 30
    assert one.arrivals == many.arrivals
    assert one.dropped.tolist() == many.dropped.tolist()
    for name in one.beliefs._fields:
        assert getattr(one.beliefs, name).tobytes() == getattr(many.beliefs, name).tobytes(), name
    assert one.covariances.tobytes() == many.covariances.tobytes()
    for mav in (1, 2, 3):
        for count in ("sent", "received", "rejected", "late", "duplicate"):
            assert getattr(one.statuses[mav], count) == getattr(many.statuses[mav], count)


def test_faults_on_the_links_in_real_time(tmp_path: Path) -> None:
    changes = ["fleet.mavs=3", "fleet.duration_s=2", "faults.loss=0.3", "faults.delay_ms=40"]
    experiment = load("cold_start", changes, seed=5, realtime=True)
    outcome, summary = run(experiment, tmp_path / "run", False, Quiet())
    assert outcome == Outcome()
    assert summary is not None
    recording = recording_of(experiment, tmp_path / "run")
    arrived = [each for arrivals in recording.arrivals.values() for each in arrivals]
    lost = recording.dropped.sum()
    assert 0.1 < lost / (lost + len(arrived)) < 0.5
    assert {each.topic for each in arrived} == {"odometry", "detections"}


class Acting(Quiet):
    """Does something to a run that is on its way: all processes have met and something is recorded."""

    def __init__(self, act: Callable[[list[psutil.Process]], None]) -> None:
        self._act, self._before = act, _children()
        self.children: list[psutil.Process] = []

    def show(self, progress: Progress) -> None:
        if progress.sim_s > 0 and not self.children:
            self.children = [child for child in _children() if child not in self._before]
            self._act(self.children)


def _children() -> list[psutil.Process]:
    return psutil.Process().children(recursive=True)


def fly_an_hour(acting: Acting, folder: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    """The exit status of a run that does not come to its end."""
    monkeypatch.setattr(terminal, "display", lambda *_: acting)
    changes = ["--set", "fleet.mavs=2", "--set", "fleet.duration_s=3600"]
    status = main(["run", "line", *changes, "--out", str(folder)])
    assert len(acting.children) == 4
    assert not [child for child in acting.children if child.is_running()]
    assert json.loads((folder / "summary.json").read_text())["ticks"] > 0
    return status


def test_ctrl_c_writes_what_was_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    acting = Acting(lambda _: os.kill(os.getpid(), signal.SIGINT))
    assert fly_an_hour(acting, tmp_path / "run", monkeypatch) == 130
    assert capsys.readouterr().err == f"swarm: interrupted; what was recorded is in {tmp_path / 'run'}\n"


def test_a_killed_agent_ends_the_run_and_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def kill(children: list[psutil.Process]) -> None:
        (agent,) = (child for child in children if child.cmdline()[-2:] == ["--mav", "2"])
        agent.kill()

    assert fly_an_hour(Acting(kill), tmp_path / "run", monkeypatch) == 1
    assert capsys.readouterr().err.startswith("swarm: mav_2 ended early (killed by SIGKILL)")


@pytest.mark.parametrize("how", ["", "--in-process"])
def test_a_run_whose_output_nobody_reads_any_more_ends_at_once_and_without_a_word(tmp_path: Path, how: str) -> None:
    """As with `swarm run line | head -1`."""
    command = [sys.executable, "-m", "deploy", "run", "line", "--out", tmp_path / "run", *how.split()]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as swarm:
        assert swarm.stdout is not None
        assert swarm.stderr is not None
        assert swarm.stdout.readline()
        swarm.stdout.close()
        assert swarm.stderr.read() == b""
    assert swarm.returncode == 141
    assert read_log(tmp_path / "run" / "log.mcap").packets  # what was flown is there
    assert not [each for each in psutil.process_iter(["cmdline"]) if str(tmp_path) in (each.info["cmdline"] or [])]


@pytest.mark.parametrize(
    ("output", "status", "words"),
    [(">&-", 0, ""), ("2>&-", 0, ""), (">/dev/full", 1, "swarm: [Errno 28] No space left on device\n")],
)
def test_a_run_that_cannot_say_anything_goes_on_or_says_why_not(
    tmp_path: Path, output: str, status: int, words: str
) -> None:
    run = f"exec {sys.executable} -m deploy run line --in-process --set fleet.duration_s=0.5 --out {tmp_path / 'run'}"
    ended = subprocess.run(["sh", "-c", f"{run} {output}"], stderr=subprocess.PIPE, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (status, words)
