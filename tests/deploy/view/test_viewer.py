"""Does the viewer show the run? In a headless browser, if the extra is installed; and what is said if not?"""

import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from agent.interface.tables import BadExperiment
from deploy.__main__ import BAD_INPUT, FAILED, FINE, main
from deploy.view import window
from deploy.view.window import NoWindow, Window, free_ports
from tests.deploy.conftest import Flown
from tests.deploy.view.browser import PROGRAM, Browser

needs_rerun = pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="the extra viz is not installed")
needs_browser = pytest.mark.skipif(PROGRAM is None, reason="there is no Chromium here")
ENTITIES = (
    "truth/mavs",
    "truth/trails",
    "links",
    "errors",
    "ticks",
    "states/1",
    "agents/1/mavs",
    "agents/3/detections",
)
PATIENCE_S = 200.0  # until the run must be there: the browser draws without a graphics card


@pytest.fixture
def nothing_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    missing = ("rerun", "rerun_cli", "foxglove")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in missing else found(name))


@pytest.mark.usefixtures("nothing_installed")
@pytest.mark.parametrize(
    "words",
    [
        ["view", "DIR"],
        ["run", "cold_start", "--view", "--out", "OUT"],
        ["export", "DIR", "--format", "rrd", "--out", "OUT"],
        ["export", "DIR", "--format", "mcap-foxglove", "--out", "OUT"],
    ],
)
def test_without_the_extra_one_line_says_how_to_get_it(
    words: list[str], flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"DIR": str(flown.folder), "OUT": str(tmp_path / "out")}
    assert main([places.get(word, word) for word in words]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "make viz" in said
    assert not (tmp_path / "out").exists()


def test_seeing_it_live_needs_processes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "cold_start", "--view", "--in-process"]) == BAD_INPUT
    assert "swarm view DIR" in capsys.readouterr().err


def test_a_viewer_that_does_not_start_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "rerun"
    broken.write_text("#!/bin/sh\necho there is no display\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setattr(window, "program", lambda: broken)
    with pytest.raises(NoWindow, match="there is no display"):
        Window(False, tmp_path / "logs" / "window.txt")


def test_a_viewer_that_does_not_start_is_a_failure(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> None:
        raise NoWindow("the viewer did not start: why")

    monkeypatch.setattr(window, "program", lambda: tmp_path)
    monkeypatch.setattr(window, "Window", refuse)
    assert main(["run", "cold_start", "--view", "--out", str(tmp_path / "out")]) == FAILED
    assert "did not start: why" in capsys.readouterr().err


def test_ports_are_free_and_different() -> None:
    assert len(set(free_ports(5))) == 5


def test_where_the_program_is_missing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(BadExperiment, match="not installed"):
        window.program()


@needs_rerun
def test_an_exported_recording_holds_everything(flown: Flown, tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    assert main(["export", str(flown.folder), "--format", "rrd", "--out", str(file)]) == FINE
    listed = subprocess.run(
        [window.program(), "rrd", "stats", file], capture_output=True, text=True, check=True, timeout=60
    )
    printed = subprocess.run(
        [window.program(), "rrd", "print", "-v", file], capture_output=True, text=True, check=True, timeout=60
    )
    for entity in ENTITIES:
        assert f"/{entity}" in printed.stdout, entity
    assert int(re.sub(r"\D", "", re.search(r"num_rows = (.*)", listed.stdout)[1])) > 36 * 3 * 3  # type: ignore[index]


@pytest.fixture
def page(flown: Flown, tmp_path: Path) -> Iterator[str]:
    """Of `swarm view DIR --web`, while it lasts."""
    small = tmp_path / "run"
    shutil.copytree(flown.folder, small)
    with subprocess.Popen(
        [sys.executable, "-m", "deploy", "view", str(small), "--web"], stderr=subprocess.PIPE, text=True
    ) as child:
        assert child.stderr is not None
        for line in child.stderr:
            if (found := re.search(r"(http://127\.0\.0\.1:\d+/\S*): until", line)) is not None:
                yield found[1]
                break
        child.send_signal(signal.SIGINT)
        assert child.wait(timeout=20) == FINE  # Ctrl-C is the way to leave it


@needs_rerun
@needs_browser
@pytest.mark.system
@pytest.mark.timeout(300)
def test_in_a_browser_it_is_to_be_seen(page: str, tmp_path: Path) -> None:
    assert_seen(page, tmp_path, "view.png")


@needs_rerun
@needs_browser
@pytest.mark.system
@pytest.mark.timeout(300)
def test_a_run_of_processes_is_seen_and_stays_until_it_is_left(tmp_path: Path) -> None:
    words = ["run", "cold_start", "--web", "--set", "fleet.mavs=3", "--set", "fleet.duration_s=2.0"]
    program = [sys.executable, "-m", "deploy", *words, "--out", str(tmp_path / "run")]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as child:
        assert child.stdout is not None
        said = ""
        for line in child.stdout:
            said += line
            if (found := re.search(r"(http://127\.0\.0\.1:\d+/\S*): until", line)) is not None:
                break
        assert found is not None, said
        assert f"to be seen at {found[1]}" in said  # from the beginning
        assert_seen(found[1], tmp_path, "live.png")
        child.send_signal(signal.SIGINT)
        assert child.wait(timeout=20) == FINE
    assert (tmp_path / "run" / "logs" / "viewer.txt").read_text() == ""


def assert_seen(page: str, folder: Path, name: str) -> None:
    artefact = Path(os.environ.get("SCREENSHOTS", folder)) / name
    with Browser(folder / "profile") as browser:
        browser.open(page)
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            shot = browser.screenshot()
            artefact.write_bytes(shot)
            if mavs_seen(shot) >= 3:
                return
    pytest.fail(f"the MAVs are not to be seen: {artefact}")


def mavs_seen(png: bytes) -> int:
    """How many of three MAVs' colours there are in the left half, where the team is."""
    from matplotlib import colormaps

    image = matplotlib.image.imread(BytesIO(png))[..., :3]
    left = image[: int(0.9 * len(image)), : int(0.6 * image.shape[1])].reshape(-1, 3)
    hue = left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-6)
    saturated = left.max(axis=1) - left.min(axis=1) > 0.15
    colors = colormaps["viridis"](np.linspace(0.15, 1.0, 3))[:, :3]
    colors /= np.linalg.norm(colors, axis=1, keepdims=True)
    return sum(int((saturated & (hue @ color > 0.985)).sum() > 60) for color in colors)
