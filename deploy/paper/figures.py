"""What do the paper's figures look like here? The same axes, ours, the twin that is told, and dead reckoning; SVG."""

from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from agent.interface.frames import Array, wrap
from agent.interface.sensors import Detector
from deploy.page.figures import TIME, VECTOR, image
from deploy.paper.cost import Row
from deploy.paper.experiments import COST_TIMES
from deploy.report import ROUNDING, STYLES, logarithmic

Runs = list[dict[str, Any]]  # of one experiment, seed by seed: what `flights` keeps
ORDER = ("naive", "ours", "clairvoyant")


def sensors(run: dict[str, Any]) -> str:
    """Bearing and distance: what was measured against what is true, and the model."""
    seen, model = {name: np.array(values) for name, values in run["seen"].items()}, Detector()
    off = wrap(seen["measured_rad"] - seen["bearing_rad"])
    with rc_context(VECTOR):
        figure = Figure(figsize=(10.5, 3.4), layout="constrained")
        bearing, distance = figure.subplots(1, 2)
        for axis, true, measured, unit in (
            (bearing, seen["bearing_rad"], seen["bearing_rad"] + off, "rad"),
            (distance, seen["distance_m"], seen["measured_m"], "m"),
        ):
            axis.plot(true, measured, ".", color="0.6", markersize=2, label="measured", rasterized=True)
            axis.set_xlabel(f"true {'bearing' if axis is bearing else 'distance'} [{unit}]")
            axis.set_ylabel(f"measured [{unit}]")
        line = np.array([-np.pi, np.pi])
        bearing.plot(line, line, color="#D55E00", label="model")
        reach = np.array([0, seen["distance_m"].max()])
        distance.plot(reach, reach, color="#D55E00", label="model")
        for sign in (-3, 3):
            edge = reach + sign * model.range_sigma_m(reach)
            distance.plot(
                reach, edge, color="#D55E00", linewidth=0.8, linestyle="--", label="3 σ" if sign > 0 else None
            )
        for axis in (bearing, distance):
            axis.legend(frameon=False)
        return image(figure)


def errors(runs: Runs, kinds: tuple[str, ...]) -> str:
    """Root mean square errors over time: the median of the seeds, and all of them as a band."""
    with rc_context(VECTOR):
        figure = Figure(figsize=(10.5, 2.8), layout="constrained")
        axes = figure.subplots(1, len(kinds), squeeze=False)[0]
        for axis, kind in zip(axes, kinds, strict=True):
            for whose in ORDER:
                _band(axis, runs, f"{whose}.{kind}", whose, STYLES[whose])
            axis.set_title(f"{kind} position", loc="left")
            axis.set_ylabel("RMSE over pairs [m]")
            _finish(axis)
        return image(figure)


def convergence(runs: Runs) -> str:
    """How the line comes about: the formation itself, and the paper's E_r(t, T) of robot 1."""
    with rc_context(VECTOR):
        figure = Figure(figsize=(10.5, 2.8), layout="constrained")
        shape, final = figure.subplots(1, 2)
        _band(shape, runs, "formation_m", "ours", STYLES["ours"])
        shape.set_title("to the desired relative positions", loc="left")
        shape.set_ylabel("RMS distance [m]")
        _band(final, runs, "to_final", "ours", STYLES["ours"])
        final.set_title("the paper's $E_r(t, T)$: estimate to final state", loc="left")
        final.set_ylabel("squares summed over the team [m²]")
        for axis in (shape, final):
            _finish(axis)
        return image(figure)


def cost(rows: list[Row]) -> str:
    """One update against N, and how many times faster gating and evaluation make it."""
    n = [row.n for row in rows]
    with rc_context(VECTOR):
        figure = Figure(figsize=(10.5, 3.0), layout="constrained")
        time, ratio = figure.subplots(1, 2)
        time.plot(n, [row.plain_ms for row in rows], marker="s", label="every hypothesis", **_line("naive"))
        time.plot(n, [row.fast_ms for row in rows], marker="o", label="gated and evaluated", **_line("ours"))
        time.set_ylabel("one update [ms]")
        ratio.plot(n, [saved(row) for row in rows], marker="o", label="here", **_line("ours"))
        ratio.plot(list(COST_TIMES), list(COST_TIMES.values()), "k^", label="the paper", linestyle="none")
        for robots, times in COST_TIMES.items():
            ratio.annotate(f"{times:g}", (robots, times), xytext=(6, -3), textcoords="offset points")
        ratio.set_ylabel("times faster")
        for axis in (time, ratio):
            logarithmic(axis)
            axis.set_xticks(n)
            axis.set_xlabel("number of robots")
            axis.legend(frameon=False)
        return image(figure)


def saved(row: Row) -> float:
    assert row.plain_ms is not None
    return row.plain_ms / row.fast_ms


def _line(name: str) -> dict[str, Any]:
    return {key: value for key, value in STYLES[name].items() if key in ("color", "linestyle")}


def _band(axis: Axes, runs: Runs, curve: str, label: str, style: dict[str, Any]) -> None:
    time_s, values = runs[0]["time_s"], together(runs, curve)
    seen = np.isfinite(values).all(axis=0)  # while all runs have a value
    middle = np.where(seen, np.median(values, axis=0), np.nan)
    axis.plot(time_s, middle, label=label, **style)
    low, high = (np.where(seen, edge, np.nan) for edge in (values.min(axis=0), values.max(axis=0)))
    axis.fill_between(time_s, low, high, color=style["color"], alpha=0.15, linewidth=0)


def together(runs: Runs, curve: str) -> Array:
    """(runs, K) what there is of this curve; NaN elsewhere, and where nothing but rounding is left."""
    values = np.array([[np.nan if each is None else each for each in run["curves"][curve]] for run in runs])
    return np.where(values > ROUNDING, values, np.nan)


def _finish(axis: Axes) -> None:
    axis.set_xlabel(TIME)
    if any((np.asarray(line.get_ydata()) > 0).any() for line in axis.lines):
        logarithmic(axis)
    axis.legend(frameon=False, ncols=3)
