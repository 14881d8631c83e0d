"""How is the paper reproduced? All is flown, drawn and written down: paper.html, and paper.md with the same table."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from agent.interface import clock
from agent.interface.frames import wrap
from deploy.experiment import VERSIONS, version
from deploy.paper import cost, figures, flights
from deploy.paper.cost import Row
from deploy.paper.deviations import DEVIATIONS
from deploy.paper.experiments import COST_REPORTED, FLIGHTS, LINE, RUN_1, SEEDS, SENSOR_REPORTED, SEQUENCES
from deploy.study import interval

ROOT = Path(__file__).parents[2]
SIZES = range(3, 10)


class Part(NamedTuple):
    """One figure of the paper, and ours."""

    figure: str
    what: str
    reported: str
    ours: str
    image: str


class Line(NamedTuple):
    """One row of the result table; mean and 95 % interval over the seeds."""

    experiment: str
    relative: str
    told: str
    naive: str
    times: str  # how many times better than dead reckoning
    absolute: str
    localised: str
    wrong: int


def build(
    folder: Path,
    processes: int,
    say: Callable[[str], None],
    counter: Callable[[int], Callable[[int], None]],
    seeds: range = SEEDS,
    sizes: range = SIZES,
) -> Path:
    """Flies what is missing in the folder and writes paper.html and paper.md there; returns the page.

    Args:
        processes: side by side.
        say: what is being done.
        counter: of a number of runs gives what shows their progress.
    """
    names, runs_folder = [each.experiment for each in FLIGHTS], folder / "flights"
    left = flights.missing(names, seeds, runs_folder)
    say(f"{len(names) * len(seeds) - left} of {len(names) * len(seeds)} runs are there" + (", flying" if left else ""))
    runs = flights.fly(names, seeds, runs_folder, processes, counter(left))
    rows = _timed(folder / "cost.json", sizes, say)
    say("drawing")
    content: dict[str, Any] = {
        "parts": parts(runs, rows),
        "lines": [line(runs[each.experiment], each.experiment) for each in FLIGHTS],
        "deviations": DEVIATIONS,
        "up": os.path.relpath(ROOT, folder.resolve()),
        "seeds": f"seeds {seeds[0]} to {seeds[-1]}",
        "date": "{}-{}-{}".format(*re.findall(r"(....)(..)(..)-", clock.utc_text())[0]),
        "versions": ", ".join(f"{name} {version(name)}" for name in VERSIONS),
        "cost": rows,
    }
    environment = Environment(
        loader=PackageLoader("deploy", "."), autoescape=select_autoescape(("html",)), undefined=StrictUndefined
    )
    environment.filters["saved"] = figures.saved
    for name in ("paper.md", "paper.html"):
        (folder / name).write_text(environment.get_template(f"paper/{name}").render(content))
    return folder / "paper.html"


def _timed(file: Path, sizes: range, say: Callable[[str], None]) -> list[Row]:
    """Of this version of the programs."""
    version = flights.programs()
    try:
        kept = json.loads(file.read_text())
        if kept["version"] == version and [row[0] for row in kept["rows"]] == list(sizes):
            return [Row(*row) for row in kept["rows"]]
    except (OSError, ValueError, KeyError):
        pass
    rows = []
    for row in cost.rows(sizes):
        rows.append(row)
        say(f"one update of {row.n} robots: {row.fast_ms:.2f} ms, {figures.saved(row):.1f} times faster than all of it")
    file.write_text(json.dumps({"version": version, "rows": rows}))
    return rows


def parts(runs: dict[str, figures.Runs], rows: list[Row]) -> list[Part]:
    """In the paper's order."""
    run_1 = runs[RUN_1.experiment]
    found = [
        Part(
            "sensor models: (a) bearing, (b) distance",
            f"{len(run_1[0]['seen']['distance_m'])} true detections of run 1, seed 0",
            SENSOR_REPORTED,
            fitted(run_1[0]["seen"]),
            figures.sensors(run_1[0]),
        )
    ]
    for each in (RUN_1, *SEQUENCES):
        kinds = ("absolute", "relative") if each is RUN_1 else ("relative",)
        mine = runs[each.experiment]
        found.append(Part(each.figure, each.what, each.reported, in_words(mine, kinds), figures.errors(mine, kinds)))
    flown = runs[LINE.experiment]
    last = [run["summary"]["flight"]["formation_rms_m"] for run in flown]
    words = f"{sum(each is not None for each in last)} of {len(last)} reached the line"
    reached = [each for each in last if each is not None]
    if reached:
        words += f", {_interval(reached)} m RMS from it in the last 5 s"
    found.append(Part(LINE.figure, LINE.what, LINE.reported, words, figures.convergence(flown)))
    ends = [f"{figures.saved(row):,.1f} times with {row.n} robots" for row in (rows[0], rows[-1])]
    ours = " to ".join(ends) + "; medians, one core"
    found.append(
        Part("computation time", "one update, with and without these steps", COST_REPORTED, ours, figures.cost(rows))
    )
    return found


def fitted(seen: dict[str, list[float]]) -> str:
    """The noise of what was measured, in the paper's terms."""
    values = {name: np.array(each) for name, each in seen.items()}
    bearing = float(np.std(wrap(values["measured_rad"] - values["bearing_rad"])))
    off, true = np.abs(values["measured_m"] - values["distance_m"]), values["distance_m"]
    slope, offset = np.polyfit(true, off * np.sqrt(np.pi / 2), 1, w=1 / true)  # mean of |e| is sigma sqrt(2 / pi)
    return f"measured: bearing σ = {bearing:.4f} rad; distance σ = {slope:.4f} d + {offset:.4f} m"


def in_words(runs: figures.Runs, kinds: tuple[str, ...]) -> str:
    said = []
    for kind in kinds:
        ratios = [run["summary"]["naive"][kind]["rmse_m"] / run["summary"][kind]["rmse_m"] for run in runs]
        own = _interval([run["summary"][kind]["rmse_m"] for run in runs])
        said.append(f"{kind} RMSE {own} m, {np.mean(ratios):.1f} times better than dead reckoning from the known start")
    return "; ".join(said)


def line(runs: figures.Runs, name: str) -> Line:
    summaries = [run["summary"] for run in runs]
    times = [max(mav["localised_at_s"] or np.inf for mav in each["mavs"]) for each in summaries]
    return Line(
        experiment=name,
        relative=_interval([each["relative"]["rmse_m"] for each in summaries]),
        told=_interval([each["clairvoyant"]["relative"]["rmse_m"] for each in summaries]),
        naive=_interval([each["naive"]["relative"]["rmse_m"] for each in summaries]),
        times=f"{np.mean([_ratio(each) for each in summaries]):.1f}",
        absolute=_interval([each["absolute"]["rmse_m"] for each in summaries]),
        localised=f"{max(times):.1f}" if np.isfinite(max(times)) else "not in all",
        wrong=sum(mav["wrong_commits"] for each in summaries for mav in each["mavs"]),
    )


def _ratio(summary: dict[str, Any]) -> float:
    return float(summary["naive"]["relative"]["rmse_m"] / summary["relative"]["rmse_m"])


def _interval(values: list[float]) -> str:
    found = interval([float(value) for value in values])
    mean, high = found["mean"], found["high"]
    return "-" if mean is None else f"{mean:.4f}" + ("" if high is None else f" ± {high - mean:.4f}")
