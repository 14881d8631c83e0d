"""What does a run look like? The figures: errors over time, and a study's cells. The only module with matplotlib."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure  # not pyplot, which keeps every figure and chooses a window system
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from agent.interface.frames import Array
from deploy import commits, metrics
from deploy.summary import Analysis, Course

# Okabe and Ito's colours, told apart by everyone; line styles and markers tell them apart in grey.
STYLES: dict[str, dict[str, Any]] = {
    "ours": {"color": "#0072B2", "linestyle": "-", "linewidth": 1.6},
    "clairvoyant": {"color": "#000000", "linestyle": (0, (1, 1.5)), "linewidth": 1.0},  # often on top of ours
    "naive": {"color": "#D55E00", "linestyle": (0, (5, 2)), "linewidth": 1.2},
}
MARKERS = {"naive": "s", "clairvoyant": "^", "ours": "o"}
SMALL: Any = {"font.size": 8, "axes.titlesize": 9, "legend.fontsize": 8, "axes.grid": True, "grid.alpha": 0.3}


def draw_errors(analysis: Analysis, experiment: str, path: Path) -> None:
    """Relative and absolute error over time: RMSE in m and deg, and the paper's squared sums."""
    recording = analysis.recording
    courses = {"ours": analysis.ours, "clairvoyant": analysis.clairvoyant, "naive": analysis.naive}
    localised = commits.all_localised_at(recording.beliefs.states, recording.time_s)
    with rc_context(SMALL):
        figure = Figure(figsize=(10.5, 5.6))
        axes = figure.subplots(2, 3, sharex=True)
        figure.subplots_adjust(0.06, 0.08, 0.99, 0.88, wspace=0.25, hspace=0.16)  # a layout engine takes half a second
        for row, kind in zip(axes, ("relative", "absolute"), strict=True):
            for name, course in courses.items():
                for axis, values in zip(row, _series(course, kind), strict=True):
                    axis.plot(recording.time_s, values, label=name, **STYLES[name])
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
        figure.legend(handles, labels, loc="upper right", ncols=3, frameon=False)
        fleet = recording.fleet
        figure.suptitle(
            f"{experiment}, seed {fleet.seed}: {fleet.mavs} MAVs, {fleet.rate_hz:g} Hz", x=0.01, ha="left", fontsize=10
        )
        figure.savefig(path, dpi=150)


def _series(course: Course, kind: str) -> tuple[Array, Array, Array]:
    """(K,) RMSE in m, in deg and sum of squares in m^2, of the pairs that are known: from before they are scored."""
    error: metrics.Errors = getattr(course, kind)
    known = course.known
    position, yaw = np.where(known, error.position_m, np.nan), np.where(known, error.yaw_rad, np.nan)
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
        _logarithmic(axis)


def _logarithmic(axis: Axes) -> None:
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
        _logarithmic(error)
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
