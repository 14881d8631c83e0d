"""What does the page show of a run over its time? Consistency, states, association, cost and links; all as SVG."""

import base64
import io
from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from agent.interface.frames import Array
from agent.interface.messages import GONE, NEIGHBOURS, STALE, STATES
from deploy import fault_marks
from deploy.recording import UNKNOWN, Recording
from deploy.report import SMALL, STYLES, logarithmic
from deploy.summary import Analysis

VECTOR: Any = SMALL | {"svg.hashsalt": "swarm", "svg.fonttype": "none", "font.family": "sans-serif"}
TIME = "simulated time [s]"
SMOOTH_S = 1.0
ACROSS = 4  # panels in a row
# Of the states in the order of `STATE_WORDS`; they differ in lightness, too.
STATE_COLORS = ("#E69F00", "#F0E442", "#0072B2", "#999999", "#444444", "#FFFFFF")
STATE_WORDS = (*STATES, *NEIGHBOURS[STALE:], "no agent")
ABSENT = len(STATE_WORDS) - 1


def image(figure: Figure) -> str:
    """As the address of an image that a page carries in itself; the same figure gives the same text."""
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(file.getvalue()).decode()


def consistency(analysis: Analysis) -> str:
    """Of every agent, how far off its neighbours are in the mean, and three times what its filter expects."""
    recording, mavs = analysis.recording, analysis.recording.fleet.mavs
    known = analysis.ours.known & np.isfinite(analysis.ours.relative.position_m)
    error = np.where(known, analysis.ours.relative.position_m, np.nan)
    variance = np.where(known, recording.covariances[..., :3, :3].trace(axis1=-2, axis2=-1), np.nan)
    with rc_context(VECTOR):
        rows = -(-mavs // ACROSS)
        figure = Figure(figsize=(10.5, 0.6 + 1.7 * rows), layout="constrained")
        axes = figure.subplots(rows, ACROSS, sharex=True, sharey=True, squeeze=False)
        for i, axis in enumerate(axes.flat):
            if i >= mavs:
                axis.set_visible(False)
                continue
            three_sigma = 3 * _rms(np.sqrt(variance[:, i]))
            axis.fill_between(recording.time_s, 0, three_sigma, color="0.85", linewidth=0, label="3 sigma")
            axis.plot(recording.time_s, _rms(error[:, i]), label="error", **STYLES["ours"])
            axis.set_title(f"agent {i + 1}", loc="left")
            _mark(axis, analysis)
        _top(axes[0, 0], np.nanmax(error) if known.any() else 1.0, variance)
        for row in axes:
            row[0].set_ylabel("position error,\nRMS over MAVs [m]")
        for axis in axes[-1]:
            axis.set_xlabel(TIME)
        axes[0, 0].legend(frameon=False)
        return image(figure)


def _rms(values: Array) -> Array:
    """(K,) over the last axis of (K, N); NaN where there is none."""
    count = np.isfinite(values).sum(axis=1)
    return np.asarray(np.sqrt(np.where(count > 0, np.nansum(values**2, axis=1), np.nan) / np.maximum(count, 1)))


def _top(axis: Axes, largest_m: float, variance: Array) -> None:
    """What is unsure at first is not to squeeze the rest."""
    usual = 3 * np.sqrt(np.nanmedian(variance)) if np.isfinite(variance).any() else 0.0
    axis.set_ylim(0, max(2.5 * usual, min(1.05 * largest_m, 10 * usual)) or 1.0)


def states(analysis: Analysis) -> str:
    """For every MAV, what each of the others says of it."""
    recording, mavs = analysis.recording, analysis.recording.fleet.mavs
    codes = state_codes(recording)
    rows = np.concatenate([np.delete(codes[:, :, j], j, axis=1).T for j in range(mavs)])
    with rc_context(VECTOR):
        figure = Figure(figsize=(10.5, 1.1 + 0.075 * max(len(rows), 20)), layout="constrained")
        axis = figure.subplots()
        span = (recording.time_s[0], recording.time_s[-1] + 1 / recording.fleet.rate_hz, len(rows), 0)
        axis.imshow(
            rows, aspect="auto", interpolation="nearest", extent=span, cmap=ListedColormap(list(STATE_COLORS)),
            vmin=-0.5, vmax=len(STATE_COLORS) - 0.5,
        )  # fmt: skip
        for j in range(1, mavs):
            axis.axhline(j * (mavs - 1), color="black", linewidth=0.8)
        axis.set_yticks((np.arange(mavs) + 0.5) * (mavs - 1), [f"MAV {j + 1}" for j in range(mavs)])
        axis.set_xlabel(TIME)
        axis.grid(visible=False)
        _mark(axis, analysis)
        patches = [
            Patch(facecolor=color, edgecolor="0.5", label=words)
            for color, words in zip(STATE_COLORS, STATE_WORDS, strict=True)
        ]
        figure.legend(handles=patches, loc="outside upper right", ncols=len(patches), frameon=False)
        return image(figure)


def state_codes(recording: Recording) -> Array:
    """(K, N, N) index into STATE_WORDS: what agent i says of j."""
    codes = recording.beliefs.states.astype(float)
    codes[recording.beliefs.states == UNKNOWN] = ABSENT
    for neighbour in (STALE, GONE):
        said = (recording.neighbours == neighbour) & (codes != ABSENT)
        codes[said] = len(STATES) + neighbour - STALE
    return codes


def association(analysis: Analysis) -> str:
    """Which share of the true detections was associated, and which share of those lies where it should."""
    recording = analysis.recording
    true = np.zeros(recording.ticks)
    for (k, _), labels in recording.labels.items():
        if k < recording.ticks:
            true[k] += (labels > 0).sum()
    used, inside = np.nanmean(recording.innovations, axis=1).T if recording.ticks else (true, true)
    with rc_context(VECTOR):
        figure = Figure(figsize=(10.5, 2.0), layout="constrained")
        axis = figure.subplots()
        width = max(round(SMOOTH_S * recording.fleet.rate_hz), 1)
        for words, part, whole, color, style in (
            ("associated, of all true detections", used, true, "#0072B2", "-"),
            ("inside its 95 % gate, of the associated", inside, used, "#D55E00", "--"),
        ):
            share = _mean(part, width) / np.maximum(_mean(whole, width), 1e-9)
            axis.plot(
                recording.time_s,
                np.where(_mean(whole, width) > 0, share, np.nan),
                label=words,
                color=color,
                linestyle=style,
            )
        axis.axhline(0.95, color="0.5", linewidth=0.8)
        axis.set_ylim(0, 1.1)
        axis.set_ylabel(f"share, mean of {SMOOTH_S:g} s")
        axis.set_xlabel(TIME)
        axis.legend(frameon=False, loc="lower right")
        _mark(axis, analysis)
        return image(figure)


def _mean(values: Array, width: int) -> Array:
    """(K,) over the last ticks."""
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(values))])
    first = np.maximum(np.arange(1, len(values) + 1) - width, 0)
    return np.asarray((total[1:] - total[first]) / (np.arange(1, len(values) + 1) - first))


def cost(analysis: Analysis) -> str:
    """What a tick cost the agents, beside the time that there is for it."""
    recording = analysis.recording
    with rc_context(VECTOR):
        figure = Figure(figsize=(10.5, 2.0), layout="constrained")
        axis = figure.subplots()
        there = np.isfinite(recording.tick_us).any(axis=1)
        ms = recording.tick_us[there] / 1000
        axis.semilogy(recording.time_s[there], np.nanmax(ms, axis=1), label="slowest agent", color="#D55E00", lw=0.8)
        axis.semilogy(recording.time_s[there], np.nanmedian(ms, axis=1), label="median", color="#0072B2")
        axis.axhline(1000 / recording.fleet.rate_hz, color="black", linewidth=0.8, linestyle="--", label="period")
        axis.set_ylabel("estimator, per tick [ms]")
        axis.set_xlabel(TIME)
        axis.legend(frameon=False, ncols=3)
        return image(figure)


def links(analysis: Analysis) -> str | None:
    """What became of the packets from one MAV (column) to another (row); None if no fault was injected on a link."""
    recording, mavs = analysis.recording, analysis.recording.fleet.mavs
    if not recording.arrivals:
        return None
    arrived, late_s = np.zeros((mavs, mavs)), np.zeros((mavs, mavs))
    for (k, mav), arrivals in recording.arrivals.items():
        for arrival in arrivals:
            at = mav - 1, arrival.sender - 1
            arrived[at] += 1
            late_s[at] += (k - arrival.tick) / recording.fleet.rate_hz
    with rc_context(VECTOR):
        figure = Figure(figsize=(10.5, 3.0), layout="constrained")
        for axis, (words, values, form) in zip(
            figure.subplots(1, 3),
            (
                ("packets arrived", arrived, "{:.0f}"),
                ("packets lost", recording.dropped.astype(float), "{:.0f}"),
                ("mean delay [s]", late_s / np.maximum(arrived, 1), "{:.2f}"),
            ),
            strict=True,
        ):
            _matrix(axis, words, values, form)
        return image(figure)


def _matrix(axis: Axes, words: str, values: Array, form: str) -> None:
    mavs = len(values)
    shown = np.where(np.eye(mavs, dtype=bool), np.nan, values)
    axis.imshow(shown, cmap="cividis", vmin=0)
    middle = np.nanmax(shown) / 2 if np.isfinite(shown).any() else 0.0
    for i, j in np.argwhere(np.isfinite(shown)) if mavs <= 12 else ():
        color = "black" if shown[i, j] > middle else "white"
        axis.text(j, i, form.format(shown[i, j]), ha="center", va="center", fontsize=5.5, color=color)
    axis.set_title(words, loc="left")
    axis.set_xticks(range(mavs), [str(j + 1) for j in range(mavs)])
    axis.set_yticks(range(mavs), [str(i + 1) for i in range(mavs)])
    axis.set_xlabel("from MAV")
    axis.set_ylabel("to MAV")
    axis.grid(visible=False)


def courses(names: Iterable[str], analyses: list[Analysis]) -> str:
    """Several runs, one line each: relative position error over time."""
    with rc_context(VECTOR):
        figure = Figure(figsize=(10.5, 3.0), layout="constrained")
        axis = figure.subplots()
        for n, (name, analysis) in enumerate(zip(names, analyses, strict=True)):
            error = np.where(analysis.ours.known, analysis.ours.relative.position_m, np.nan)
            course = _rms(error.reshape(len(error), -1))
            color, style = colormaps["viridis"](0.9 * n / max(len(analyses) - 1, 1)), ("-", "--", "-.", ":")[n % 4]
            axis.plot(analysis.recording.time_s, course, label=name, color=color, linestyle=style)
        if any(np.isfinite(np.asarray(drawn.get_ydata())).any() for drawn in axis.lines):
            logarithmic(axis)
        axis.set_ylabel("relative position,\nRMSE over pairs [m]")
        axis.set_xlabel(TIME)
        axis.legend(frameon=False)
        return image(figure)


def _mark(axis: Axes, analysis: Analysis) -> None:
    """The faults, as on `errors.png`."""
    end_s = analysis.recording.time_s[-1]
    for span in fault_marks.spans(analysis.faults, end_s):
        for at_s in (span.from_s, span.until_s):
            axis.axvline(at_s, color="0.4", linewidth=0.6, linestyle=":")
    for mark in fault_marks.marks(analysis.recording):
        axis.axvline(mark.at_s, color="#CC79A7", linewidth=0.9, linestyle=(0, (4, 1.5)))
