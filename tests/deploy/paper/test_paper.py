"""Is the paper reproduced as it is said, and gone on with where it was interrupted?"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.interface.frames import wrap
from agent.interface.sensors import Detector
from deploy import summary
from deploy.__main__ import BAD_INPUT, FINE, main
from deploy.clairvoyant import replay
from deploy.paper import build, cost, deviations, flights
from deploy.paper.cost import FAST, PLAIN, Row
from deploy.paper.experiments import FLIGHTS, LINE, RUN_1
from deploy.recording import Recording
from deploy.summary import Analysis
from tests.deploy.conftest import Flown

ROOT = Path(__file__).parents[3]
SEEDS = range(2)
ROWS = [Row(3, 7, 0.2, 0.8), Row(9, 1_441_729, 0.5, 4000.0)]


@pytest.fixture(scope="module")
def analysis(flown: Flown, recording: Recording) -> Analysis:
    return summary.analyse(recording, replay(recording, flown.experiment.agent))


@pytest.fixture
def folder(flown: Flown, analysis: Analysis, tmp_path: Path) -> Path:
    """As if all had been flown and timed already: every run is the one of the other tests."""
    content: dict[str, Any] = {
        "version": flights.programs(),
        "summary": flown.result.summary,
        "time_s": analysis.recording.time_s.tolist(),
        "curves": flights.curves(analysis),
        "seen": flights.seen(analysis),
    }
    made = tmp_path / "paper"
    (made / "flights").mkdir(parents=True)
    content["curves"] |= dict.fromkeys(("formation_m", "to_final"), content["curves"]["ours.relative"])
    for each in FLIGHTS:
        for seed in SEEDS:
            (made / "flights" / f"{each.experiment}-{seed}.json").write_text(json.dumps(content))
    (made / "cost.json").write_text(json.dumps({"version": flights.programs(), "rows": ROWS}))
    return made


def built(folder: Path) -> Path:
    return build.build(folder, 1, lambda _: None, lambda _: pytest.fail, SEEDS, [3, 9])  # type: ignore[arg-type]


def test_the_page_lays_ours_beside_what_the_paper_says(folder: Path, flown: Flown) -> None:
    page = built(folder)
    text = page.read_text()
    assert "{{" not in text
    assert text.count("<img ") == 2 + len(FLIGHTS)
    assert all(address.startswith("data:image/svg+xml;base64,") for address in re.findall(r'src="([^"]*)"', text))
    for words in (RUN_1.reported, LINE.what, "12.6 times", "4.0 times with 3 robots to 8,000.0 times with 9 robots"):
        assert words in text
    assert flown.result.summary is not None
    assert f"{flown.result.summary['relative']['rmse_m']:.4f}" in text
    for row in deviations.DEVIATIONS:
        assert (ROOT / row.code).is_file()
        assert (page.parent / re.findall(f'href="([^"]*{row.code})"', text)[0]).resolve() == ROOT / row.code


def test_the_same_table_is_there_for_the_readme(folder: Path) -> None:
    built(folder)
    lines = (folder / "paper.md").read_text().splitlines()
    assert re.fullmatch(r"seeds 0 to 1 each, unknown start, \d{4}-\d\d-\d\d; .*", lines[0])
    for each in FLIGHTS:
        assert sum(line.startswith(f"| `{each.experiment}` |") for line in lines) == 1


def test_the_readme_shows_a_table_that_was_made_so(folder: Path) -> None:
    built(folder)
    made = (folder / "paper.md").read_text().split("\n\n\n")[0].splitlines()
    shown = re.findall(r"<!-- make paper: .*? -->\n(.*?)\n<!-- end -->", (ROOT / "README.md").read_text(), re.DOTALL)
    lines = shown[0].splitlines()
    assert len(lines) == len(made)
    assert lines[1:4] == made[1:4]  # the heading
    assert re.fullmatch(r"seeds 0 to 9 each, unknown start, 20\d\d-\d\d-\d\d; .*", lines[0])
    for theirs, ours in zip(lines[4:], made[4:], strict=True):
        assert theirs.split("|")[1] == ours.split("|")[1]


@pytest.mark.parametrize("damage", ["half", "{}", '{"version": "of another version"}', None])
def test_a_run_that_is_not_there_as_a_whole_is_flown(damage: str | None, folder: Path) -> None:
    names = [each.experiment for each in FLIGHTS]
    assert flights.missing(names, SEEDS, folder / "flights") == 0
    file = folder / "flights" / "paper_run_1-1.json"
    if damage is None:
        file.unlink()
    else:
        file.write_text(damage)
    assert flights.missing(names, SEEDS, folder / "flights") == 1


def test_what_is_flown_is_kept(tmp_path: Path) -> None:
    seen: list[int] = []
    first = flights.fly(["cold_start"], range(1), tmp_path, 1, seen.append)
    assert seen == [1]
    assert first == flights.fly(["cold_start"], range(1), tmp_path, 1, lambda _: pytest.fail("flown again"))
    (run,) = first["cold_start"]
    assert len(run["curves"]["naive.absolute"]) == len(run["time_s"]) == 60
    assert [file.name for file in tmp_path.iterdir()] == ["cold_start-0.json"]


def test_the_sensors_are_those_of_the_paper(analysis: Analysis) -> None:
    seen = {name: np.array(values) for name, values in flights.seen(analysis).items()}
    model = Detector()
    bearing = wrap(seen["measured_rad"] - seen["bearing_rad"])
    distance = (seen["measured_m"] - seen["distance_m"]) / model.range_sigma_m(seen["distance_m"])
    assert len(bearing) > 100
    assert 0.8 < np.std(distance) < 1.2
    assert 0.8 < np.std(bearing) / model.bearing_sigma_rad < 1.6  # azimuths spread with the elevation
    assert re.fullmatch(
        r"measured: bearing σ = 0\.0\d+ rad; distance σ = 0\.0\d+ d \+ 0\.0\d+ m", build.fitted(flights.seen(analysis))
    )


def test_both_ways_of_updating_agree_on_what_is_timed() -> None:
    updates = cost.updates(3)
    assert len(updates) > 10
    for update in updates[:10]:
        results = [cost.station_update(*update, cost.CONFIG.detector.clutter_density, rules) for rules in (FAST, PLAIN)]
        np.testing.assert_allclose(results[0].poses.y, results[1].poses.y, atol=2e-3)
    row = cost.measure(3, updates[:3], with_plain=True)
    assert (row.n, row.hypotheses) == (3, 7)
    assert cost.measure(3, updates[:3], with_plain=False).plain_ms is None


def test_it_flies_its_own_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "--paper", str(tmp_path)]) == BAD_INPUT
    assert "expected no DIR" in capsys.readouterr().err
    assert main(["report"]) == BAD_INPUT
    assert "expected DIR" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["report", "--paper", "--out", str(tmp_path / "file" / "below")]) == BAD_INPUT
    assert "cannot be made" in capsys.readouterr().err


def test_by_command(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    whole = build.build
    monkeypatch.setattr(build, "build", lambda *words: whole(*words, SEEDS, [3, 9]))
    assert main(["report", "--paper", "--out", str(folder)]) == FINE
    assert capsys.readouterr().out.strip().endswith("paper.html")
