"""What does a person see? Progress of a run, results and studies on the terminal."""

import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from rich.console import Console
from rich.live import Live
from rich.table import Table

from agent.interface import clock
from deploy.progress import Progress

PLAIN_S = 2.0  # between lines when nobody watches


class Display(Protocol):
    """Shows how a run goes while it is entered."""

    def show(self, progress: Progress) -> None: ...
    def say(self, words: str) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Quiet:
    def show(self, progress: Progress) -> None:
        pass

    def say(self, words: str) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class Plain(Quiet):
    """A line now and then, for files and pipes."""

    def __init__(self) -> None:
        self._pace = Pace()
        self._last_s = -math.inf

    def show(self, progress: Progress) -> None:
        if clock.now_s() - self._last_s >= PLAIN_S:
            self._last_s = clock.now_s()
            localised = sum(mav.state == "localised" for mav in progress.mavs)
            errors = [mav.error_m for mav in progress.mavs if mav.error_m is not None]
            error = f"{max(errors):.2f} m" if errors else "unknown"
            print(
                f"{progress.sim_s:6.1f} of {progress.of_s:g} s, {self._pace.words(progress)}; {localised} of "
                f"{len(progress.mavs)} MAVs have localised all others, largest relative error {error}",
                flush=True,
            )

    def say(self, words: str) -> None:
        print(words, flush=True)


class OnTerminal(Quiet):
    """A table that stays in its place."""

    def __init__(self, title: str) -> None:
        self._title, self._pace = title, Pace()
        # No refresh thread of its own: a process's parent is the thread that started it.
        self._live = Live(f"{title}: starting", console=Console(highlight=False), auto_refresh=False, transient=True)

    def show(self, progress: Progress) -> None:
        caption = f"{progress.sim_s:.1f} of {progress.of_s:g} s, {self._pace.words(progress)}"
        table = Table(title=self._title, caption=caption, title_justify="left", caption_justify="left")
        for heading in ("MAV", "state", "localised", "relative error"):
            table.add_column(heading, justify="left" if heading == "state" else "right")
        others = len(progress.mavs) - 1
        for mav in progress.mavs:
            error = "" if mav.error_m is None else f"{mav.error_m:.3f} m"
            table.add_row(str(mav.id), mav.state, f"{mav.localised} of {others}", error)
        self._live.update(table, refresh=True)

    def say(self, words: str) -> None:
        self._live.console.print(words)

    def __enter__(self) -> Self:
        self._live.start(refresh=True)
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()


class Pace:
    """Simulated seconds per second, from the first progress on."""

    def __init__(self) -> None:
        self._begin: tuple[float, float] | None = None

    def words(self, progress: Progress) -> str:
        now_s = clock.now_s()
        if self._begin is None:
            self._begin = now_s, progress.sim_s
        wall_s, sim_s = now_s - self._begin[0], progress.sim_s - self._begin[1]
        return f"{sim_s / wall_s:.1f} times real time" if wall_s > 0 and sim_s > 0 else "starting"


def display(title: str, quiet: bool) -> Display:
    if quiet:
        return Quiet()
    return OnTerminal(title) if sys.stdout.isatty() else Plain()


def print_results(summary: dict[str, Any], folder: Path) -> None:
    """The errors of one run beside those of the baselines, and where everything is."""
    title = f"{summary['experiment']}, seed {summary['seed']}: errors over all pairs of MAVs"
    table = Table(title=title, title_justify="left")
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
    console.print(f"{folder} (errors: {folder / 'errors.png'})", soft_wrap=True)


def print_study(study: dict[str, Any], folder: Path) -> None:
    """One row per cell: mean and 95 % interval."""
    table = Table(title=f"{len(study['runs'])} runs; mean and its 95 % t interval", title_justify="left")
    for name in study["cells"][0]["grid"]:
        table.add_column(name)
    for name in (
        "runs", "relative RMSE m", "/ clairvoyant", "/ naive", "ANEES", "consistent\nANEES", "localised\nafter s",
        "wrong\ncommits",
    ):  # fmt: skip
        table.add_column(name, justify="right")
    metrics = ("relative_rmse_m", "ratio_to_clairvoyant", "ratio_to_naive", "anees")
    for cell in study["cells"]:
        band = cell["anees_band"]
        table.add_row(
            *(str(value) for value in cell["grid"].values()),
            str(cell["seeds"]),
            *(_interval(cell[name]) for name in metrics),
            f"{band['low']:.2f}..{band['high']:.2f}",
            _interval(cell["localised_at_s"], 1),
            _number(cell["wrong_commits"]["mean"], 2),
        )
    console = _console()
    console.print(table)
    console.print(str(folder), soft_wrap=True)


def counter(total: int) -> Callable[[int], None]:
    """A progress line with the time that is left, rewritten in its place on a terminal."""
    began_s = clock.now_s()
    in_place = sys.stdout.isatty()

    def show(done: int) -> None:
        left_s = (clock.now_s() - began_s) / done * (total - done)
        left = f"{left_s / 60:.0f} min" if left_s > 90 else f"{left_s:.0f} s"
        words = f"{done} of {total} runs, {left} left"
        print(f"\r{words}   " if in_place else words, end="\n" if done == total or not in_place else "", flush=True)

    return show


def _console() -> Console:
    # A table that is not looked at by a person is not to be cut at 80 columns.
    return Console(highlight=False, width=None if sys.stdout.isatty() else 140)


def _number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _interval(metric: dict[str, float | None], digits: int = 3) -> str:
    mean, low, high = metric["mean"], metric["low"], metric["high"]
    if mean is None:
        return "-"
    return f"{mean:.{digits}f}" if low is None else f"{mean:.{digits}f}\n{low:.{digits}f}..{high:.{digits}f}"
