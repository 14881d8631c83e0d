"""Do the real processes of a run, over the real network, do what the one process does, and do they all end?"""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from deploy import terminal
from deploy.__main__ import main
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
