"""What is on the page? Of each run what was flown, its result beside the others', and its figures; of each study its
table and its figure."""

import base64
import io
import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined

from agent.interface.tables import BadExperiment
from deploy import fault_marks, report, summary
from deploy.formation_figure import draw_formation
from deploy.page import figures
from deploy.run import Scored, scored
from deploy.summary import Analysis

PAGE = "report.html"
# Of the table that compares runs: what a figure is called, where it is in summary.json, how it is written.
FIGURES: tuple[tuple[str, str, str], ...] = (
    ("relative RMSE [m]", "relative.rmse_m", ".4f"),
    ("… told the identities", "clairvoyant.relative.rmse_m", ".4f"),
    ("… dead reckoning from the known start", "naive.relative.rmse_m", ".4f"),
    ("relative RMSE [deg]", "relative.rmse_deg", ".3f"),
    ("… told the identities", "clairvoyant.relative.rmse_deg", ".3f"),
    ("… dead reckoning from the known start", "naive.relative.rmse_deg", ".3f"),
    ("absolute RMSE [m]", "absolute.rmse_m", ".4f"),
    ("ANEES (1: as wrong as it believes)", "anees", ".2f"),
    ("innovations inside their 95 % gate", "nis_inside", ".3f"),
    ("95 % disagreement of two agents [m]", "disagreement_m", ".3f"),
    ("nearest two MAVs [m]", "flight.nearest_m", ".2f"),
    ("pairs that touched", "flight.collisions", "d"),
    ("last formation, RMS [m]", "flight.formation_rms_m", ".3f"),
    ("tick of the estimator, median [ms]", "estimator_ms.tick_p50", ".2f"),
    ("… 99 %", "estimator_ms.tick_p99", ".2f"),
    ("late ticks (real time)", "late_ticks", "d"),
    ("packets received", "network.received", "d"),
    ("… lost by faults", "network.dropped_by_faults", "d"),
    ("… rejected", "network.rejected", "d"),
    ("… too late", "network.late", "d"),
    ("bytes per agent and second", "network.bytes_per_agent_s", ".0f"),
    ("times real time", "real_time_factor", ".1f"),
)
CELL = ("relative_rmse_m", "ratio_to_clairvoyant", "ratio_to_naive", "anees", "localised_at_s")


class Run(NamedTuple):
    name: str  # of its folder
    content: dict[str, Any]  # summary.json's
    flown: dict[str, Any]  # what was run
    faults: list[str]
    figures: list[tuple[str, str]]  # what it shows, and the image


class Study(NamedTuple):
    name: str
    content: dict[str, Any]  # study.json's
    figure: str


def build(folders: list[Path], say: Callable[[str], None]) -> str:
    """The page about these run and study folders, HTML that needs no other file; says which one it is at.

    Raises:
        BadExperiment: one of them is neither.
        BadLog, NothingRecorded: as `score` does.
    """
    runs: list[Run] = []
    studies: list[Study] = []
    analyses: list[Analysis] = []
    for name, folder in zip(_names(folders), folders, strict=True):
        say(f"{folder} ...")
        if (folder / "log.mcap").is_file():
            found = scored(folder)
            runs.append(_run(name, found))
            analyses.append(found.analysis)
        elif (folder / "study.json").is_file():
            studies.append(_study(name, folder))
        else:
            raise BadExperiment(f"{folder}: neither log.mcap nor study.json is there, expected a run or study folder")
    environment = Environment(loader=PackageLoader("deploy", "."), autoescape=True, undefined=StrictUndefined)
    return environment.get_template("page/page.html").render(
        runs=runs,
        studies=studies,
        compared=compared(runs),
        cell=CELL,
        together=figures.courses([run.name for run in runs], analyses) if len(runs) > 1 else None,
    )


def compared(runs: list[Run]) -> list[tuple[str, list[str]]]:
    """The rows of the result table; what no run has is left out."""
    rows = []
    for words, path, form in FIGURES:
        values = [_at(run.content, path) for run in runs]
        if any(value is not None for value in values):
            rows.append((words, ["-" if value is None else format(value, form) for value in values]))
    when = [[mav["localised_at_s"] for mav in run.content["mavs"]] for run in runs]
    latest = ["never" if None in times else f"{max(times):.1f}" for times in when]
    wrong = [str(sum(mav["wrong_commits"] for mav in run.content["mavs"])) for run in runs]
    return [("all localised all others after [s]", latest), ("wrong commits", wrong), *rows] if runs else []


def _at(content: dict[str, Any], path: str) -> Any:
    for key in path.split("."):
        content = content[key]
    return content


def _names(folders: list[Path]) -> list[str]:
    """As short as tells them apart."""
    names = [folder.resolve().name for folder in folders]
    return names if len(set(names)) == len(names) else [str(folder) for folder in folders]


def _run(name: str, found: Scored) -> Run:
    analysis, content = found.analysis, summary.summarise(found.analysis, found.circumstances)
    shown = [
        ("Errors of all pairs: ours, told the identities, and dead reckoning", _errors(found)),
        ("Each agent's error, and three times what its own filter expects", figures.consistency(analysis)),
        ("What the others say of each MAV (a line an agent)", figures.states(analysis)),
        ("Association", figures.association(analysis)),
        ("Cost", figures.cost(analysis)),
    ]
    if analysis.shapes is not None:
        file = io.BytesIO()
        draw_formation(analysis, found.experiment.name, file)
        shown.insert(1, ("The formations: commanded and flown", _address("png", file.getvalue())))
    links = figures.links(analysis)
    if links is not None:
        shown.append(("Links", links))
    end_s = analysis.recording.time_s[-1]
    faults = [f"{at.from_s:g} to {at.until_s:g} s: {at.words}" for at in fault_marks.spans(analysis.faults, end_s)]
    faults += [f"{at.at_s:g} s: {at.words}" for at in fault_marks.marks(analysis.recording)]
    everywhere = fault_marks.on_all_links(analysis.faults)
    return Run(name, content, _flown(found), [f"all links: {everywhere}"] * bool(everywhere) + faults, shown)


def _flown(found: Scored) -> dict[str, Any]:
    fleet = found.analysis.recording.fleet
    versions = tomllib.loads(found.resolved).get("record", {}).get("versions", {})
    return {
        "experiment": found.experiment.name,
        "seed": fleet.seed,
        "MAVs": fleet.mavs,
        "rate": f"{fleet.rate_hz:g} Hz",
        "flown": f"{found.analysis.recording.ticks / fleet.rate_hz:g} of {fleet.duration_s:g} s",
        "mode": "real time" if fleet.realtime else "lockstep",
        "over": "Zenoh" if found.circumstances.transport == "zenoh" else "memory, in one process",
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }


def _errors(found: Scored) -> str:
    file = io.BytesIO()
    report.draw_errors(found.analysis, found.experiment.name, file)
    return _address("png", file.getvalue())


def _study(name: str, folder: Path) -> Study:
    try:
        content = json.loads((folder / "study.json").read_text())
        figure = _address("png", (folder / "study.png").read_bytes())
    except (OSError, ValueError) as error:
        raise BadExperiment(f"{folder}: cannot be read as a study: {error}") from None
    return Study(name, content, figure)


def _address(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
