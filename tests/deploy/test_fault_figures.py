"""Do the figures show the faults, in words that say what they are, and a study over two numbers as a map of them?"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from deploy import heat_map, report, summary
from deploy.__main__ import main
from deploy.fault_marks import Mark, Span, marks, on_all_links, spans
from deploy.faults import Faults, LinkRule, Partition
from deploy.heat_map import Grid, grid_of
from deploy.recording import ProcessFault, Recording


def test_conditions_in_words() -> None:
    assert on_all_links(Faults()) == ""
    assert on_all_links(Faults(loss=0.3, delay_ms=200, jitter_ms=50)) == "30 % lost, 200 ± 50 ms late"
    bursts = Faults(burst_loss=0.5, duplicates=0.1, reorder=0.05, topics=("odometry",))
    assert on_all_links(bursts) == "50 % lost in bursts of 1 s, 10 % twice, 5 % overtaken (odometry only)"
    tail = Faults(jitter_ms=20, jitter="lognormal", bandwidth_bytes_s=2000)
    assert on_all_links(tail) == "0 + log-normal 20 ms late, 2000 bytes/s"


def test_spans_are_in_the_order_of_time_and_end_with_the_run() -> None:
    faults = Faults(
        links=(LinkRule(senders=(1,), receivers=(2, 3), from_s=5.0, loss=1.0), LinkRule(from_s=99.0, loss=0.1)),
        partitions=(
            Partition(groups=((1, 2), (3,)), from_s=2.0, until_s=4.0),
            Partition(groups=((1,), (2,)), from_s=3.0, until_s=4.0, one_way=True, kept=True),
        ),
    )
    assert spans(faults, 10.0) == [
        Span(2.0, 4.0, "cut 1 2 | 3", True),
        Span(3.0, 4.0, "cut 1 > 2, kept", True),
        Span(5.0, 10.0, "100 % lost from MAV 1 to MAV 2, 3", True),
    ]


KILLS = [ProcessFault(5, 1, "kill"), ProcessFault(5, 3, "kill"), ProcessFault(9, 1, "restart")]


def test_what_is_done_at_one_time_is_one_mark(recording: Recording) -> None:
    found = marks(dataclasses.replace(recording, process_faults=KILLS))
    assert found == [Mark(0.5, "MAV 1, 3 killed"), Mark(0.9, "MAV 1 started anew")]


def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are saved from now on."""
    figures: list[Figure] = []
    before = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), before(self, *a, **k))[1])
    return figures


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in (*figure.texts, *(text for axis in figure.axes for text in axis.texts))]


def test_errors_are_drawn_with_the_faults_that_there_were(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = drawn(monkeypatch)
    cut = Partition(groups=((1,), (2, 3)), from_s=2.0, until_s=3.0)
    faults = Faults(loss=0.1, partitions=(cut,))
    disturbed = dataclasses.replace(recording, process_faults=KILLS)
    analysis = summary.analyse(disturbed, recording.beliefs, faults)
    report.draw_errors(analysis, "made", tmp_path / "errors.png")
    (figure,) = figures
    words = "\n".join(texts(figure))
    for expected in ("all links: 10 % lost", "(1) 2 to 3 s: cut 1 | 2 3", "(2) 0.5 s: MAV 1, 3 killed", "(3) 0.9 s"):
        assert expected in words.replace("\n", " ")
    labels = [line.get_label() for line in figure.axes[0].lines]
    assert report.CUT_OFF in labels
    cut_off = next(line for line in figure.axes[0].lines if line.get_label() == report.CUT_OFF)
    shown = np.flatnonzero(np.isfinite(np.asarray(cut_off.get_ydata(), float)))
    assert (shown[0], shown[-1]) == (20, 29)
    report.draw_errors(summary.analyse(recording, recording.beliefs), "made", tmp_path / "plain.png")
    assert not any("links" in text for text in texts(figures[1]))
    assert report.CUT_OFF not in [line.get_label() for line in figures[1].axes[0].lines]


def cell(loss: Any, delay: Any, mean: float | None = 0.02, localised: float = 1.0, **more: Any) -> dict[str, Any]:
    high = None if mean is None else mean * 1.1
    value = {"mean": mean, "low": None if mean is None else mean * 0.9, "high": high}
    grid = {"faults.loss": loss, "faults.delay_ms": delay} | more
    return {
        "grid": grid,
        "seeds": 4,
        "relative_rmse_m": value,
        "ratio_to_clairvoyant": value,
        "all_localised": localised,
    }


def test_a_grid_of_two_numbers_is_known_as_one() -> None:
    cells = [cell(loss, delay) for loss in (0.3, 0, 0.1) for delay in (0, 100)]
    assert grid_of(cells) == Grid("faults.loss", "faults.delay_ms", [0, 0.1, 0.3], [0, 100])


@pytest.mark.parametrize(
    "cells",
    [
        [cell(0.1, 0), cell(0.2, 0)],  # the second does not vary
        [cell(True, 0), cell(False, 1)],
        [cell("some", 0), cell("all", 1)],
        [cell(loss, delay, third=1) for loss in (0, 1) for delay in (0, 1)],
        [{"grid": {"faults.loss": loss}} for loss in (0, 1)],
        [{"grid": {}}],
    ],
)
def test_other_grids_are_not(cells: list[dict[str, Any]]) -> None:
    assert grid_of(cells) is None


def test_the_map_has_its_numbers_units_and_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = drawn(monkeypatch)
    cells = [cell(0, 0, 0.02), cell(0, 100, 0.03, 0.5), cell(0.1, 0, None, 0.0)]  # and one that failed
    grid = grid_of(cells)
    assert grid is not None
    heat_map.draw({"cells": cells, "experiment": "made", "seeds": "seeds 0 to 3"}, grid, tmp_path / "study.png")
    words = texts(figures[0])
    for expected in ("0.020", "± 0.002", "0.030", "50 %", "nothing to score", "no run"):
        assert expected in words
    assert "100 %" not in words
    assert "seeds 0 to 3; mean over 4 runs" in figures[0].get_suptitle()
    labels = {axis.get_xlabel() for axis in figures[0].axes} | {axis.get_ylabel() for axis in figures[0].axes}
    assert {"faults.delay_ms [ms]", "faults.loss [share]", "relative RMSE [m]"} <= labels
    assert imread(tmp_path / "study.png").std() > 0.1  # not blank


def test_a_study_over_two_numbers_leaves_a_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = drawn(monkeypatch)
    words = ["study", "cold_start", "--seeds", "0:1", "--set", "fleet.mavs=3", "--set", "fleet.duration_s=0.5"]
    grid = ["--grid", "faults.loss=0,0.5", "--grid", "faults.delay_ms=0,100"]
    assert main([*words, *grid, "--jobs", "1", "--out", str(tmp_path)]) == 0
    assert texts(figures[0]).count("nothing to score") == 8  # of half a second
    assert (tmp_path / "study.png").exists()
