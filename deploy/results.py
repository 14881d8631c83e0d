"""What does a person read at the end? The tables of a run and of a study on the terminal."""

import math
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

LATER = ("position_1s_m", "position_1s_p95_m", "yaw_1s_rad", "yaw_1s_p95_rad")


def print_results(summary: dict[str, Any], folder: Path) -> None:
    """The errors of one run beside those of the baselines, and where everything is."""
    title = f"{summary['experiment']}, seed {summary['seed']}: errors over all pairs of MAVs"
    table = Table(title=escape(title), title_justify="left")
    for heading in ("pose", "estimated by", "RMSE m", "RMSE deg", "final m", "final deg", "max m"):
        table.add_column(heading, justify="left" if heading in ("pose", "estimated by") else "right", no_wrap=True)
    rows = {"ours": summary, "clairvoyant": summary["clairvoyant"], "naive": summary["naive"]}
    for kind in ("relative", "absolute"):
        for row, scores in rows.items():
            keys = ("rmse_m", "rmse_deg", "final_rmse_m", "final_rmse_deg", "max_m")
            table.add_row(kind if row == "ours" else "", row, *(_number(scores[kind][key]) for key in keys))
        table.add_section()
    console = _console()
    console.print(table)
    mavs, late = summary["mavs"], summary["late_ticks"]
    times = [mav["localised_at_s"] for mav in mavs if mav["localised_at_s"] is not None]
    when = f", all of them after {max(times):.1f} s" if len(times) == len(mavs) else ""
    console.print(
        f"{len(times)} of {len(mavs)} MAVs localised all others{when}; "
        f"{sum(mav['wrong_commits'] for mav in mavs)} wrong commits; ANEES {_number(summary['anees'])}; "
        f"{_number(summary['real_time_factor'], 1)} times real time"
        + (f"; {late} late ticks" if summary["mode"] == "realtime" and late is not None else "")
    )
    for (state, reason), numbers in _not_localised(mavs).items():
        words = f"MAV {', '.join(numbers)}: {state} at the end" + (f" ({reason})" if reason else "")
        console.print(words, markup=False, soft_wrap=True)
    if summary["flight"]["formations"]:
        console.print(_flown(summary["flight"]), soft_wrap=True)
    console.print(f"{folder} (errors: {folder / 'errors.png'})", markup=False, soft_wrap=True)


def _flown(flight: dict[str, Any]) -> str:
    legs = [
        f"{leg['formation']} not reached"
        if leg["at_s"] is None
        else f"{leg['formation']} after {leg['at_s']:.1f} s, {leg['rms_m']:.3f} m RMS"
        for leg in flight["formations"]
    ]
    touched = f"{flight['collisions'] or 'none'} touched"
    return f"Formations: {'; '.join(legs)}. Nearest {_number(flight['nearest_m'], 2)} m, {touched}"


def _not_localised(mavs: list[dict[str, Any]]) -> dict[tuple[str, str | None], list[str]]:
    """The agents that have not localised all others at the end, by their state and reason."""
    groups: dict[tuple[str, str | None], list[str]] = {}
    for mav in mavs:
        if mav["state"] != "localised":
            groups.setdefault((mav["state"], mav["reason"]), []).append(str(mav["id"]))
    return groups


def print_study(study: dict[str, Any], folder: Path) -> None:
    """One row per cell in each of two tables: how good the estimates are, and how the MAVs came to be localised."""
    console, runs = _console(), len(study["runs"])
    console.print(_estimates(study["cells"], f"{runs} runs; mean and its 95 % t interval"))
    console.print(
        _localisation(study["cells"], "Who was localised when, how often wrongly, and how well one second later")
    )
    console.print(str(folder), markup=False, soft_wrap=True)


def _estimates(cells: list[dict[str, Any]], title: str) -> Table:
    headings = (
        "runs",
        "relative\nRMSE m",
        "ratio to\nclairvoyant",
        "ratio\nto naive",
        "ANEES",
        "consistent\nANEES",
        "tick p99\nms",
    )
    metrics = ("relative_rmse_m", "ratio_to_clairvoyant", "ratio_to_naive", "anees")
    table = _of_cells(cells, title, headings)
    for cell in cells:
        band = cell["anees_band"]
        table.add_row(
            *(str(value) for value in cell["grid"].values()),
            str(cell["seeds"]),
            *(_interval(cell[name]) for name in metrics),
            f"{band['low']:.2f}..{band['high']:.2f}",
            _number(cell["largest_tick_p99_ms"], 1),
        )
    return table


def _localisation(cells: list[dict[str, Any]], title: str) -> Table:
    headings = (
        "all\nlocalised", "after s", "95 % of\nruns, s", "ambiguous\nto the end", "wrong\ncommits",
        "ANEES\nat commit", "m, 1 s\nlater", "deg, 1 s\nlater",
    )  # fmt: skip
    table = _of_cells(cells, title, headings)
    for cell in cells:
        latest, wrong = cell["localised_at_s"]["p95"], cell["wrong_commits"]
        m, m95, rad, rad95 = (cell[key]["mean"] for key in LATER)
        table.add_row(
            *(str(value) for value in cell["grid"].values()),
            _share(cell["all_localised"]),
            _interval(cell["localised_at_s"], 1),
            "never" if latest is None else f"{latest:.1f}",
            _share(cell["ambiguous_to_the_end"]),
            f"{wrong['total']}\nin {wrong['runs']} of {cell['seeds']}" if wrong["total"] else "0",
            _number(cell["commit_nees"]["mean"], 2),
            "-" if m is None else f"{_number(m)}\n95 %: {_number(m95)}",
            "-" if rad is None else f"{_degrees(rad)}\n95 %: {_degrees(rad95)}",
        )
    return table


def _of_cells(cells: list[dict[str, Any]], title: str, headings: tuple[str, ...]) -> Table:
    table = Table(title=title, title_justify="left")
    for name in cells[0]["grid"]:
        table.add_column(name, overflow="fold")
    for heading in headings:
        table.add_column(heading, justify="right")
    return table


def _console() -> Console:
    # A table that is not looked at by a person is not to be cut at 80 columns.
    return Console(highlight=False, width=None if sys.stdout.isatty() else 140)


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _interval(metric: dict[str, float | None], digits: int = 3) -> str:
    mean, high = metric["mean"], metric["high"]
    if mean is None:
        return "-"
    return f"{mean:.{digits}f}" if high is None else f"{mean:.{digits}f}\n±{high - mean:.{digits}f}"


def _share(part: float) -> str:
    return f"{100 * part:.0f} %"


def _degrees(rad: float) -> str:
    return f"{math.degrees(rad):.2f}"
