"""Does a study count runs and mean figures as it should, and can its tables be read?"""

import json
from pathlib import Path
from typing import Any

import pytest

from deploy import results, study, summary

SCORES = {"rmse_m": 0.02, "rmse_deg": 0.2}
TABLE = {
    "commit_nees": 1.2, "position_1s_m": 0.05, "yaw_1s_rad": 0.02, "position_1s_p95_m": 0.1, "yaw_1s_p95_rad": 0.04,
}  # fmt: skip


def run(*mavs: tuple[str, float | None, int], cell: int = 1, **changed: Any) -> dict[str, Any]:
    """The part of a summary that a study looks at; of every MAV its state, when it localised all others, and wrong
    commits."""
    keys = ("state", "localised_at_s", "wrong_commits")
    return {
        "grid": {"agent.some_key": cell},
        "agents": len(mavs),
        "relative": SCORES,
        "absolute": SCORES,
        "naive": {"relative": SCORES},
        "clairvoyant": {"relative": SCORES},
        "anees": 1.0,
        "nis_inside": 0.95,
        "disagreement_m": 0.01,
        "registration": TABLE,
        "flight": {"nearest_m": 0.9, "collisions": 0, "formation_rms_m": None},
        "estimator_ms": {"tick_p99": 10.0},
        "mavs": [dict(zip(keys, mav, strict=True)) for mav in mavs],
    } | changed


def good(at_s: float, **changed: Any) -> dict[str, Any]:
    return run(("localised", at_s, 0), ("localised", at_s - 1, 0), **changed)


def evaluated(*runs: dict[str, Any]) -> list[dict[str, Any]]:
    cells: list[dict[str, Any]] = study.evaluate(list(runs), "hand-made", "seeds")["cells"]
    return cells


def test_a_run_that_does_not_localise_everybody_takes_for_ever() -> None:
    (cell,) = evaluated(good(4.0), good(6.0), run(("localised", 2.0, 0), ("ambiguous", None, 0)))
    assert cell["all_localised"] == pytest.approx(2 / 3)
    assert cell["localised_at_s"]["mean"] == 5.0  # of those that did
    assert cell["localised_at_s"]["p95"] is None
    assert evaluated(good(4.0), good(6.0))[0]["localised_at_s"]["p95"] == 6.0


def test_of_twenty_runs_one_may_fail() -> None:
    times = [float(seconds) for seconds in range(1, 20)]
    assert study.percentile_95([None, *times]) == 19.0
    assert study.percentile_95([None, None, *times[1:]]) is None
    assert study.percentile_95([20.0, *times]) == 19.0
    assert study.percentile_95([None]) is None


def test_wrong_commits_are_added_up_and_their_runs_counted() -> None:
    (cell,) = evaluated(good(1.0), run(("localised", 1.0, 2), ("localised", 1.0, 1)), run(("localised", 1.0, 1)))
    assert (cell["wrong_commits"]["total"], cell["wrong_commits"]["runs"]) == (4, 2)
    assert cell["wrong_commits"]["mean"] == pytest.approx(4 / 3)


def test_ambiguous_to_the_end_is_a_run_in_which_every_agent_is() -> None:
    ambiguous, searching = ("ambiguous", None, 0), ("searching", None, 0)
    runs = [run(ambiguous, ambiguous), run(ambiguous, searching), run(ambiguous, ("localised", 3.0, 0)), good(3.0)]
    assert evaluated(*runs)[0]["ambiguous_to_the_end"] == 0.25


def test_registration_is_meaned_and_the_dearest_tick_found() -> None:
    later = TABLE | {"position_1s_m": 0.07, "commit_nees": None}
    dear, unknown = {"tick_p99": 31.0}, {"tick_p99": None}
    (cell,) = evaluated(
        good(1.0), good(1.0, registration=later, estimator_ms=dear), good(1.0, estimator_ms=unknown)
    )  # fmt: skip
    assert cell["position_1s_m"]["mean"] == pytest.approx((0.05 + 0.07 + 0.05) / 3)
    assert cell["commit_nees"]["mean"] == pytest.approx(1.2)
    assert cell["yaw_1s_p95_rad"].keys() == {"mean", "low", "high"}
    assert cell["largest_tick_p99_ms"] == 31.0
    assert evaluated(good(1.0, estimator_ms=unknown))[0]["largest_tick_p99_ms"] is None


def test_never_is_null_in_json_and_a_word_on_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nothing = dict.fromkeys(TABLE)
    runs = [good(4.0), run(("localised", 4.0, 3)), run(("ambiguous", None, 0), cell=2, registration=nothing)]
    content = study.evaluate(runs, "hand-made", "seeds")
    assert json.loads(summary.to_json(content))["cells"][1]["localised_at_s"] == dict.fromkeys(
        ["mean", "low", "high", "p95"]
    )
    results.print_study(content, tmp_path)
    first, second = _rows(capsys.readouterr().out)
    assert first == ["1", "100 %", "4.0", "4.0", "0 %", "3", "1.20", "0.050", "1.15"]
    assert second == ["2", "0 %", "-", "never", "100 %", "0", "-", "-", "-"]


def _rows(printed: str) -> list[list[str]]:
    """The first lines of the second table's cells."""
    table = printed[printed.index("Who was localised") :].splitlines()
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in table if line.startswith("│")]
    return [cells for cells in lines if cells[0]]
