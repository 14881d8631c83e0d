"""Who starts the processes of a run, and sees to it that all of them end?

Each gets a session of its own, so that Ctrl-C reaches only the launcher, and dies with the launcher even if that is
killed. The run is over when all that end by themselves have; it has failed as soon as one ends in another way.
"""

import asyncio
import contextlib
import os
import signal
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from deploy.fleet import Process
from deploy.leash import die_with

STOP_S = 3.0  # from SIGTERM to SIGKILL
STOP_RECORDER_S = 8.0  # it may wait five seconds for what is still on its way
TOGETHER_S = 10.0  # when one has ended well, the others must, so soon
ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1"}  # threads of small algebra only fight for the cores


@dataclass(frozen=True)
class Outcome:
    failure: str | None = None  # one line: which process, why, where its log is
    interrupted: bool = False  # by Ctrl-C or SIGTERM


@dataclass
class _Running:
    row: Process
    child: asyncio.subprocess.Process
    ended: asyncio.Task[int]
    log: Path


def run(table: tuple[Process, ...], logs: Path, progress: Callable[[bytes], None]) -> Outcome:
    """Runs all processes to the end; afterwards none is left.

    Args:
        table: what to start.
        logs: directory for one <name>.txt each.
        progress: is called with every line of those that report.
    """
    return asyncio.run(_run(table, logs, progress))


async def _run(table: tuple[Process, ...], logs: Path, progress: Callable[[bytes], None]) -> Outcome:
    interrupt = asyncio.Event()
    with _signals(interrupt):
        running: list[_Running] = []
        readers: list[asyncio.Task[None]] = []
        try:
            for row in table:
                if interrupt.is_set():
                    break
                running.append(await _start(row, logs / f"{row.name}.txt"))
                if row.reports:
                    readers.append(asyncio.create_task(_read(running[-1].child, progress)))
            outcome = await _watch(running, interrupt)
        finally:
            await _stop([one for one in running if one.row.ends == "by itself"], STOP_S)
            told = [one for one in running if one.row.ends == "when told"]
            await _stop(told, STOP_RECORDER_S)
            await asyncio.gather(*readers)
        if outcome == Outcome():
            for one in told:
                if one.ended.result() != 0:
                    return Outcome(failure=_words(one))
        return outcome


async def _start(row: Process, log: Path) -> _Running:
    with log.open("wb") as file:
        child = await asyncio.create_subprocess_exec(
            *row.command,
            stdin=DEVNULL,
            stdout=PIPE if row.reports else file,
            stderr=file,
            env=os.environ | ENVIRONMENT,
            start_new_session=True,
            preexec_fn=partial(die_with, os.getpid()),
        )
    return _Running(row, child, asyncio.create_task(child.wait()), log)


async def _read(child: asyncio.subprocess.Process, progress: Callable[[bytes], None]) -> None:
    assert child.stdout is not None
    async for line in child.stdout:
        progress(line)


async def _watch(running: list[_Running], interrupt: asyncio.Event) -> Outcome:
    """Returns at the end of the run, whichever it is; processes may be left."""
    interrupted = asyncio.create_task(interrupt.wait())
    try:
        first: str | None = None  # the first that ended well
        loop = asyncio.get_running_loop()
        deadline: float | None = None
        while True:
            if interrupt.is_set():
                return Outcome(interrupted=True)
            for one in running:
                if one.ended.done() and (one.ended.result() != 0 or one.row.ends == "when told"):
                    return Outcome(failure=_words(one))
            awaited = [one for one in running if one.row.ends == "by itself"]
            left = [one for one in awaited if not one.ended.done()]
            if not left:
                return Outcome()
            if len(left) < len(awaited) and deadline is None:
                deadline = loop.time() + TOGETHER_S
                first = next(one.row.name for one in awaited if one.ended.done())
            if deadline is not None and loop.time() >= deadline:
                names = ", ".join(one.row.name for one in left)
                where = left[0].log
                return Outcome(
                    failure=f"{first} ended, but {TOGETHER_S:g} s later these had not: {names} (log: {where})"
                )
            pending = [one.ended for one in running if not one.ended.done()]
            await asyncio.wait(
                [interrupted, *pending],
                timeout=None if deadline is None else deadline - loop.time(),
                return_when=asyncio.FIRST_COMPLETED,
            )
    finally:
        interrupted.cancel()


async def _stop(running: list[_Running], patience_s: float) -> None:
    """SIGTERM, then SIGKILL for those that do not heed it, then for whatever they left in their sessions."""
    left = [one for one in running if not one.ended.done()]
    for one in left:
        _signal(one, signal.SIGTERM)
    if left:
        await asyncio.wait([one.ended for one in left], timeout=patience_s)
    for one in running:
        _signal(one, signal.SIGKILL)
    if running:
        await asyncio.wait([one.ended for one in running])


def _signal(one: _Running, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(one.child.pid, number)


def _words(one: _Running) -> str:
    """Which process ended, why, its last words and where the rest of them is."""
    code = one.ended.result()
    why = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"
    said = [line for line in one.log.read_text(errors="replace").splitlines() if line.strip()]
    last = f": {said[-1].strip()}" if said else ""
    return f"{one.row.name} ended early ({why}){last} (log: {one.log})"


_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextlib.contextmanager
def _signals(interrupt: asyncio.Event) -> Iterator[None]:
    loop = asyncio.get_running_loop()
    for number in _ENDS:
        loop.add_signal_handler(number, interrupt.set)
    try:
        yield
    finally:
        for number in _ENDS:
            loop.remove_signal_handler(number)
