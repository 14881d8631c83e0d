"""Does the page about runs and studies tell what it should, without any other file?"""

import base64
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import matplotlib.image
import numpy as np
import pytest

from agent.interface.messages import GONE, LOCALISED
from deploy.__main__ import BAD_INPUT, FINE, main
from deploy.page import build, figures
from deploy.recording import UNKNOWN, Recording
from tests.deploy.conftest import Flown

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "some_study"
    small = ["--set", "fleet.duration_s=1", "--set", "fleet.mavs=3", "--grid", "world.detector.P_D=0.8,0.9"]
    assert main(["study", "cold_start", "--seeds", "0:1", "--jobs", "1", *small, "--out", str(folder)]) == FINE
    return folder


@pytest.fixture(scope="module")
def page(flown: Flown, study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    copy = tmp_path_factory.mktemp("copy") / "another_run"
    shutil.copytree(flown.folder, copy)
    file = copy.parent / "page.html"
    assert main(["report", str(flown.folder), str(copy), str(study), "--out", str(file)]) == FINE
    return file


def test_it_says_what_was_run_and_how_it_went(page: Path, flown: Flown) -> None:
    text = page.read_text()
    assert flown.result.summary is not None
    for words in ("run, another_run, some_study", "cold_start", "numpy ", "lockstep", "P_D</th>"):
        assert words in text
    result = re.search(r'<table id="result">(.*?)</table>', text, re.DOTALL)
    assert result is not None
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", result[1])
    assert cells[::2] == cells[1::2]  # the two are the same run
    assert f"{flown.result.summary['relative']['rmse_m']:.4f}" in cells


def test_it_needs_no_other_file(page: Path) -> None:
    text = page.read_text()
    addresses = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert len(addresses) >= 12
    for address in addresses:
        kind, _, content = address.partition(";base64,")
        decoded = base64.b64decode(content, validate=True)
        if kind == "data:image/svg+xml":
            assert ElementTree.fromstring(decoded).tag.endswith("svg")
        else:
            assert (kind, decoded[:4]) == ("data:image/png", b"\x89PNG")


def test_the_same_folders_give_the_same_page(flown: Flown) -> None:
    said: list[str] = []
    assert build.build([flown.folder], said.append) == build.build([flown.folder], said.append)
    assert said == [f"{flown.folder} ..."] * 2


def test_of_one_folder_it_is_written_into_it(flown: Flown, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(flown.folder, copy)
    assert main(["report", str(copy)]) == FINE
    assert (copy / build.PAGE).is_file()


def test_what_is_no_run_and_no_study_is_said(
    flown: Flown, study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(study, broken)
    (broken / "study.json").write_text("{")
    for words, expected in (
        ([str(tmp_path)], "neither log.mcap nor study.json is there"),
        ([str(broken)], "cannot be read as a study"),
        ([str(study), str(study)], f"swarm: {study}: this folder is given more than once\n"),
        ([str(study), "--out", str(tmp_path / "nowhere" / "page.html")], "cannot be written"),
    ):
        assert main(["report", *words]) == BAD_INPUT
        assert expected in capsys.readouterr().err


def test_what_an_agent_says_of_a_neighbour_goes_before_what_it_knows_of_it(recording: Recording) -> None:
    neighbours = recording.neighbours.copy()
    neighbours[-1, 0, 1] = GONE
    states = recording.beliefs.states.copy()
    states[-1, 2] = UNKNOWN
    codes = figures.state_codes(
        replace(recording, neighbours=neighbours, beliefs=recording.beliefs._replace(states=states))
    )
    words = [figures.STATE_WORDS[int(code)] for code in codes[-1].ravel()]
    assert states[-1, 0, 2] == LOCALISED
    assert words[:3] == ["localised", "gone", "localised"]
    assert words[6:] == ["no agent"] * 3


@pytest.mark.system
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_a_browser_shows_it(page: Path, tmp_path: Path) -> None:
    screenshot = tmp_path / "page.png"
    assert CHROMIUM is not None
    quiet = ["--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-component-update"]
    subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", *quiet, f"--user-data-dir={tmp_path / 'profile'}",
         "--window-size=1100,4000", f"--screenshot={screenshot}", page.as_uri()],
        check=True, capture_output=True, timeout=100,
    )  # fmt: skip
    shown = matplotlib.image.imread(screenshot)[..., :3]
    filled = (shown.reshape(40, -1, *shown.shape[1:]).std(axis=(1, 2, 3)) > 0.01).sum()
    assert filled >= 30  # of forty stripes
    assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 100  # colours
