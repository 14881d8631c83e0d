"""What does a person see while it lasts? The progress of a run or a study on the terminal."""

import math
import sys
import textwrap
from collections import Counter
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from agent.interface import clock, messages
from agent.interface.messages import STATES
from deploy.progress import MavProgress, Progress

PLAIN_S = 2.0  # between lines when nobody watches
LITTLE = 0.01  # share of packets that need not be spoken of
REASON_WIDTH = 60  # characters of such a line
LOCALISED = STATES[messages.LOCALISED]


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
            print(f"{progress.sim_s:6.1f} of {progress.of_s:g} s, {self._pace.words(progress)}; {in_words(progress)}")
            sys.stdout.flush()

    def say(self, words: str) -> None:
        print(words, flush=True)


class OnTerminal(Quiet):
    """A table that stays in its place."""

    def __init__(self, title: str) -> None:
        self._title, self._pace = title, Pace()
        # No refresh thread of its own: a process's parent is the thread that started it.
        self._live = Live(
            escape(f"{title}: starting"), console=Console(highlight=False), auto_refresh=False, transient=True
        )

    def show(self, progress: Progress) -> None:
        caption = f"{progress.sim_s:.1f} of {progress.of_s:g} s, {self._pace.words(progress)}"
        self._live.update(as_table(progress, self._title, caption), refresh=True)

    def say(self, words: str) -> None:
        self._live.console.print(words, markup=False)

    def __enter__(self) -> Self:
        self._live.start(refresh=True)
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()


def in_words(progress: Progress) -> str:
    """How many agents are in which state, with one of the reasons, and how far off they are."""
    count = Counter(mav.state for mav in progress.mavs)
    words = f"{count[LOCALISED]} of {len(progress.mavs)} MAVs have localised all others"
    words += "".join(f", {count[state]} {state}" for state in reversed(STATES) if state != LOCALISED and count[state])
    given = [mav for mav in progress.mavs if mav.reason]
    if given:
        reason = textwrap.shorten(given[0].reason, REASON_WIDTH, placeholder=" ...")
        words += f" (MAV {given[0].id} about MAV {given[0].least_known}: {reason})"
    for state in ("stale", "gone"):
        called = sorted({other for mav in progress.mavs for other in getattr(mav, state)})
        words += f", {state}: MAV {', '.join(map(str, called))}" if called else ""
    holding = [str(mav.id) for mav in progress.mavs if mav.holding]
    words += f", holding: MAV {', '.join(holding)}" if holding else ""
    errors = [mav.error_m for mav in progress.mavs if mav.error_m is not None]
    words += ", largest relative error " + (f"{max(errors):.2f} m" if errors else "unknown")
    lost = max((mav.lost for mav in progress.mavs if mav.lost is not None), default=0.0)
    words += f", up to {100 * lost:.0f} % lost" if lost >= LITTLE else ""
    ticks = [mav.tick_ms for mav in progress.mavs if mav.tick_ms is not None]
    return words + (f", slowest tick {max(ticks):.0f} ms" if ticks else "")


def as_table(progress: Progress, title: str, caption: str) -> Table:
    """One row per agent; the reasons take the width that is left, if there are any."""
    table = Table(title=escape(title), caption=caption, title_justify="left", caption_justify="left")
    neighbours = any(mav.stale or mav.gone or mav.holding for mav in progress.mavs)
    headings = ("MAV", "state", "localised", "relative error", "lost", "tick", *(["neighbours"] if neighbours else []))
    for heading in headings:
        table.add_column(heading, justify="left" if heading in ("state", "neighbours") else "right", no_wrap=True)
    reasons = any(mav.reason for mav in progress.mavs)
    if reasons:
        table.add_column("why")
    for mav in progress.mavs:
        error = "" if mav.error_m is None else f"{mav.error_m:.3f} m"
        lost = "" if mav.lost is None else f"{100 * mav.lost:.0f} %"
        tick = "" if mav.tick_ms is None else f"{mav.tick_ms:.0f} ms"
        known = f"{mav.localised} of {len(progress.mavs) - 1}"
        cells: list[str | Text] = [str(mav.id), mav.state, known, error, lost, tick]
        if neighbours:
            cells.append(neighbours_in_words(mav))
        if reasons:
            why = f"MAV {mav.least_known}: {mav.reason}" if mav.reason else ""
            cells.append(Text(why, no_wrap=True, overflow="ellipsis"))  # as it is: brackets are no mark-up
        table.add_row(*cells)
    return table


def neighbours_in_words(mav: MavProgress) -> str:
    """Who is not alive, as this MAV sees it: "3 gone, 4 5 stale"; and whether it holds itself."""
    words = [
        f"{' '.join(map(str, mavs))} {state}" for mavs, state in ((mav.gone, "gone"), (mav.stale, "stale")) if mavs
    ]
    return ", ".join((["holding"] if mav.holding else []) + words)


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
