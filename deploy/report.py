"""What does a run look like? The figures: errors over time, and a study's cells. Nobody but heat_map draws, too."""

import textwrap
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure  # not pyplot, which keeps every figure and chooses a window system
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from agent.interface.frames import Array
from deploy import commits, fault_marks, metrics
from deploy.fault_marks import Mark, Span
from deploy.metrics import Mask
from deploy.summary import Analysis, Course

# Okabe and Ito's colours, told apart by everyone; line styles and markers tell them apart in grey.
STYLES: dict[str, dict[str, Any]] = {
    "ours": {"color": "#0072B2", "linestyle": "-", "linewidth": 1.6},
    "clairvoyant": {"color": "#000000", "linestyle": (0, (1, 1.5)), "linewidth": 1.0},  # often on top of ours
    "naive": {"color": "#D55E00", "linestyle": (0, (5, 2)), "linewidth": 1.2},
}
CUT_OFF = "ours, pairs cut off from each other"
STYLES[CUT_OFF] = STYLES["ours"] | {"linestyle": (0, (5, 1, 1, 1)), "linewidth": 1.1}
ROUNDING = 1e-9  # m, rad: no error, but a logarithm of it would be drawn
MARKERS = {"naive": "s", "clairvoyant": "^", "ours": "o"}
SMALL: Any = {"font.size": 8, "axes.titlesize": 9, "legend.fontsize": 8, "axes.grid": True, "grid.alpha": 0.3}


def draw_errors(analysis: Analysis, experiment: str, file: Path | BinaryIO) -> None:
    """Relative and absolute error over time: RMSE in m and deg, and the paper's squared sums."""
    recording = analysis.recording
    courses = {"ours": analysis.ours, "clairvoyant": analysis.clairvoyant, "naive": analysis.naive}
    localised = commits.all_localised_at(recording.beliefs.states, recording.time_s)
    with rc_context(SMALL):
        figure = Figure(figsize=(10.5, 5.6))
        axes = figure.subplots(2, 3, sharex=True)
        for row, kind in zip(axes, ("relative", "absolute"), strict=True):
            for name, course in courses.items():
                for axis, values in zip(row, _series(course, kind, course.known), strict=True):
                    axis.plot(recording.time_s, values, label=name, **STYLES[name])
            if analysis.ours.cut_off.any():
                for axis, values in zip(row, _series(analysis.ours, kind, analysis.ours.cut_off), strict=True):
                    axis.plot(recording.time_s, values, label=CUT_OFF, **STYLES[CUT_OFF])
            letter = "E_r" if kind == "relative" else "E"
            _axis(row[0], f"{kind} position", "RMSE over pairs [m]", log=kind == "relative")
            _axis(row[1], f"{kind} yaw", "RMSE over pairs [deg]", log=kind == "relative")
            _axis(row[2], f"{kind}, the paper's ${letter}$", "squares summed over the team [m²]", log=True)
        for axis in axes[1]:
            axis.set_xlabel("simulated time [s]")
        if np.isfinite(localised).all():
            for axis in axes.flat:
                axis.axvline(localised.max(), color="0.55", linewidth=0.8, zorder=0)
            axes[0, 0].annotate(
                "all localised",
                (localised.max(), 0.98),
                xycoords=("data", "axes fraction"),
                xytext=(3, 0),
                textcoords="offset points",
                va="top",
                fontsize=7,
                color="0.35",
            )
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="upper right", ncols=4, frameon=False)
        lines = _faults(axes, analysis)
        figure.text(0.01, 0.945, "\n".join(lines), va="top", fontsize=7.5, color="0.25")
        top = 0.90 - 0.025 * len(lines) if lines else 0.88
        figure.subplots_adjust(0.06, 0.08, 0.99, top, wspace=0.25, hspace=0.16)  # a layout engine takes half a second
        fleet = recording.fleet
        figure.suptitle(
            f"{experiment}, seed {fleet.seed}: {fleet.mavs} MAVs, {fleet.rate_hz:g} Hz", x=0.01, ha="left", fontsize=10
        )
        figure.savefig(file, dpi=150, format="png")


def _faults(axes: Any, analysis: Analysis) -> list[str]:
    """Spans are grey, what happens to a process is a line; both are numbered. Returns lines that say what they are."""
    recording, words = analysis.recording, []
    everywhere = fault_marks.on_all_links(analysis.faults)
    if everywhere:
        words.append(f"all links: {everywhere}")
    spans = fault_marks.spans(analysis.faults, recording.time_s[-1])
    events: list[Span | Mark] = [*spans, *fault_marks.marks(recording)]
    for number, event in enumerate(events, 1):
        at_s = event.from_s if isinstance(event, Span) else event.at_s
        until = f" to {event.until_s:g}" if isinstance(event, Span) else ""
        words.append(f"({number}) {at_s:g}{until} s: {event.words}")
        for axis in axes.flat:
            if isinstance(event, Span):
                axis.axvspan(at_s, event.until_s, color="0.85" if event.cut else "0.93", zorder=-1, linewidth=0)
            else:
                axis.axvline(at_s, color="#CC79A7", linewidth=0.9, linestyle=(0, (4, 1.5)), zorder=0)
        for axis in axes[0]:
            axis.annotate(
                str(number), (at_s, 0.02), xycoords=("data", "axes fraction"), xytext=(2, 0),
                textcoords="offset points", fontsize=7, color="0.25",
            )  # fmt: skip
    return textwrap.wrap("; ".join(words), 190, max_lines=3, placeholder=" ...")


def _series(course: Course, kind: str, shown: Mask) -> tuple[Array, Array, Array]:
    """(K,) RMSE in m, in deg and sum of squares in m^2, of the pairs that are shown (K, N, N)."""
    error: metrics.Errors = getattr(course, kind)
    position, yaw = (np.where(shown & (each > ROUNDING), each, np.nan) for each in (error.position_m, error.yaw_rad))
    return (
        metrics.rms_over_pairs(position),
        np.rad2deg(metrics.rms_over_pairs(yaw)),
        metrics.team_sum_of_squares(position),
    )


def _axis(axis: Axes, title: str, label: str, log: bool) -> None:
    axis.set_title(title, loc="left")
    axis.set_ylabel(label)
    axis.margins(x=0.01)
    if not log:
        axis.set_ylim(bottom=0)
    elif any((np.asarray(line.get_ydata()) > 0).any() for line in axis.lines):
        logarithmic(axis)


def logarithmic(axis: Axes) -> None:
    """With plain numbers, and with some between the powers of ten where there are few of those."""
    axis.set_yscale("log")
    low, high = axis.get_ylim()
    between = (1.0, 2.0, 5.0) if high < 1000 * low else (1.0,)
    axis.yaxis.set_major_locator(LogLocator(subs=between))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_formatter(FuncFormatter(lambda number, _: f"{number:g}"))


def draw_study(study: dict[str, Any], path: Path) -> None:
    """Every run of every cell, with mean and 95 % interval: relative error beside the baselines, and ANEES."""
    cells = study["cells"]
    labels = ["\n".join(f"{key.split('.')[-1]} = {value}" for key, value in cell["grid"].items()) for cell in cells]
    with rc_context(SMALL):
        figure = Figure(figsize=(min(max(6.5, 2.5 + 1.1 * len(cells)), 16), 6), layout="constrained")
        error, consistency = figure.subplots(2, 1, sharex=True)
        for shift, (name, key) in zip(
            (-0.22, 0.0, 0.22),
            (
                ("ours", "relative_rmse_m"),
                ("clairvoyant", "clairvoyant_relative_rmse_m"),
                ("naive", "naive_relative_rmse_m"),
            ),
            strict=True,
        ):
            _cells(error, cells, key, shift, name)
        error.set_ylabel("relative RMSE [m]")
        logarithmic(error)
        error.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
        _cells(consistency, cells, "anees", 0.0, "ours")
        for x, cell in enumerate(cells):
            band = cell["anees_band"]
            consistency.fill_between(
                [x - 0.35, x + 0.35], band["low"], band["high"], color="0.85", zorder=0, linewidth=0
            )
        consistency.axhline(1.0, color="0.5", linewidth=0.8)
        consistency.set_ylabel("ANEES per degree of freedom [1]\n(grey: mean of a consistent filter, 95 %)")
        consistency.set_xticks(range(len(cells)), labels if any(labels) else [study["experiment"]])
        consistency.set_xlim(-0.6, len(cells) - 0.4)
        figure.suptitle(
            f"{study['experiment']}: {study['seeds']}; dots are runs, bars the mean and its 95 % interval",
            x=0.01,
            ha="left",
            fontsize=10,
        )
        figure.savefig(path, dpi=150)


def _cells(axis: Axes, cells: list[dict[str, Any]], key: str, shift: float, name: str) -> None:
    color = STYLES[name]["color"]
    for x, cell in enumerate(cells):
        values = [value for value in cell["values"][key] if value is not None]
        spread = np.linspace(-0.05, 0.05, len(values)) if len(values) > 1 else [0.0]
        axis.plot(x + shift + np.array(spread[: len(values)]), values, ".", color=color, alpha=0.35, markersize=4)
        mean, low, high = (cell[key][part] for part in ("mean", "low", "high"))
        if mean is None:
            continue
        bar = None if low is None else [[mean - low], [high - mean]]
        axis.errorbar(
            x + shift,
            mean,
            bar,
            fmt=MARKERS[name],
            color=color,
            capsize=4,
            markersize=6,
            label=name if x == 0 else None,
        )
