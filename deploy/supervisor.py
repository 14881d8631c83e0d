"""Who starts the processes of a run, and sees to it that all of them end?

Each gets a session of its own, so that Ctrl-C reaches only the launcher, and dies with the launcher even if that is
killed. The run is over when all that end by themselves have; it has failed as soon as one ends in another way, unless
the director of the experiment's faults has it killed.
"""

import asyncio
import contextlib
import os
import signal
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from agent.interface.process import READY
from deploy.fleet import Process
from deploy.leash import die_with
from deploy.process_faults import Director

STOP_S = 3.0  # from SIGTERM to SIGKILL
STOP_RECORDER_S = 8.0  # it may wait five seconds for what is still on its way
READY_S = 30.0  # what the run does without, too, is waited for so long
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
    ready: asyncio.Event = field(default_factory=asyncio.Event)
    stopped: bool = False  # by the director: it need not end by itself
    halted: str = ""  # by this signal from outside, and not continued since


def run(
    table: tuple[Process, ...],
    logs: Path,
    progress: Callable[[bytes], None],
    director: Director | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Outcome:
    """Runs all processes to the end; afterwards none is left.

    Args:
        table: what to start.
        logs: directory for one <name>.txt each.
        progress: is called with every line of those that report; what it raises ends the run and is raised here.
        director: has processes killed, stopped and restarted.
        say: is told which process somebody else has stopped, and when it goes on.
    """
    return asyncio.run(_run(table, _Crew(table, logs, progress, director, say), director))


async def _run(table: tuple[Process, ...], crew: "_Crew", director: Director | None) -> Outcome:
    interrupt = asyncio.Event()
    with _signals(dict.fromkeys(_ENDS, interrupt.set) | {signal.SIGCHLD: crew.notice_halts}):
        directing: asyncio.Task[None] | None = None
        try:
            for row in table:
                if interrupt.is_set():
                    break
                if director is None or row.name not in director.late:
                    await crew.launch(row)
                if row.ends == "whenever":
                    await crew.await_ready(row.name, interrupt)
            if director is not None:
                directing = asyncio.create_task(director.direct(crew))
            outcome = crew.with_halts(await crew.watch(interrupt, directing))
        finally:
            if directing is not None:
                directing.cancel()
            told = await crew.end()
        if outcome == Outcome():
            for one in told:
                if one.ended.result() != 0:
                    return Outcome(failure=_words(one))
        return outcome


class _Crew:
    """The processes that run, as the director knows them."""

    def __init__(
        self,
        table: tuple[Process, ...],
        logs: Path,
        progress: Callable[[bytes], None],
        director: Director | None,
        say: Callable[[str], None],
    ) -> None:
        self._rows = {row.name: row for row in table}
        self._logs, self._progress, self._director, self._say = logs, progress, director, say
        self._running: dict[str, _Running] = {}
        self._readers: list[asyncio.Task[None]] = []
        self._changed = asyncio.Event()

    async def launch(self, row: Process, *more: str) -> None:
        log = self._logs / f"{row.name}.txt"
        with log.open("ab") as file:
            child = await asyncio.create_subprocess_exec(
                *row.command,
                *more,
                stdin=DEVNULL if self._director is None else PIPE,
                stdout=PIPE,
                stderr=file,
                env=os.environ | ENVIRONMENT,
                start_new_session=True,
                preexec_fn=partial(die_with, os.getpid()),
            )
        one = self._running[row.name] = _Running(row, child, asyncio.create_task(child.wait()), log)
        self._readers.append(asyncio.create_task(self._read(one)))
        self._changed.set()

    async def start(self, name: str, *more: str) -> None:
        await self.launch(self._rows[name], *more)
        await self._running[name].ready.wait()

    async def await_ready(self, name: str, interrupt: asyncio.Event) -> None:
        """Returns when it is, or will not be any more, or takes too long."""
        one = self._running[name]
        tasks = [asyncio.create_task(event.wait()) for event in (one.ready, interrupt)]
        await asyncio.wait([one.ended, *tasks], timeout=READY_S, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            task.cancel()

    async def kill(self, name: str) -> None:
        one = self._running.pop(name)  # from here on nobody wonders how it ends
        self._changed.set()
        _signal(one, signal.SIGKILL)
        await one.ended

    def stop(self, name: str) -> None:
        self._running[name].stopped = True
        _signal(self._running[name], signal.SIGSTOP)

    def go_on(self, name: str) -> None:
        _signal(self._running[name], signal.SIGCONT)
        self._running[name].stopped = False

    def notice_halts(self) -> None:
        """Who has been stopped or continued, by whom else than the director?"""
        for name, one in self._running.items():
            with contextlib.suppress(ChildProcessError):  # it has ended, which is noticed elsewhere
                told = os.waitid(os.P_PID, one.child.pid, os.WSTOPPED | os.WCONTINUED | os.WNOHANG)
                if told is None:
                    continue
                if told.si_code == os.CLD_STOPPED and not one.stopped:
                    one.halted = signal.Signals(told.si_status).name
                    self._say(f"{name} was stopped by {one.halted}; kill -CONT {one.child.pid} lets it go on")
                elif told.si_code == os.CLD_CONTINUED and one.halted:
                    one.halted = ""
                    self._say(f"{name} goes on")

    def with_halts(self, outcome: Outcome) -> Outcome:
        """What others complain of is the fault of who stands still."""
        halts = [f"{name} was stopped by {one.halted}" for name, one in self._running.items() if one.halted]
        return replace(outcome, failure="; then ".join([*halts, outcome.failure])) if outcome.failure else outcome

    def tell(self, name: str, line: bytes) -> None:
        pipe = self._running[name].child.stdin
        assert pipe is not None
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # it has ended, which is noticed elsewhere
            pipe.write(line + b"\n")

    async def all_ready(self) -> None:
        for one in list(self._running.values()):
            if one.row.ends != "whenever":
                await one.ready.wait()

    async def _read(self, one: _Running) -> None:
        assert one.child.stdout is not None
        async for line in one.child.stdout:
            if self._director is not None and self._director.heard(one.row.name, line):
                continue
            if line.strip() == READY:
                one.ready.set()
            elif one.row.reports:
                self._progress(line)
            else:
                with one.log.open("ab") as file:
                    file.write(line)

    async def watch(self, interrupt: asyncio.Event, directing: asyncio.Task[None] | None) -> Outcome:
        """Returns at the end of the run, whichever it is; processes may be left."""
        interrupted = asyncio.create_task(interrupt.wait())
        try:
            first: str | None = None  # the first that ended well
            loop = asyncio.get_running_loop()
            deadline: float | None = None
            while True:
                self._changed.clear()
                running = list(self._running.values())
                if interrupt.is_set():
                    return Outcome(interrupted=True)
                if directing is not None and directing.done():
                    directing.result()  # what it raised
                    directing = None
                for reader in self._readers:
                    if reader.done():
                        reader.result()  # what `progress` raised
                for one in running:
                    if one.row.ends == "whenever" or not one.ended.done():
                        continue
                    if one.ended.result() != 0 or one.row.ends == "when told":
                        return Outcome(failure=_words(one))
                awaited = [one for one in running if one.row.ends == "by itself" and not one.stopped]
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
                changed = asyncio.create_task(self._changed.wait())
                unfinished = [*(one.ended for one in running), *self._readers]
                pending = [interrupted, changed, *(task for task in unfinished if not task.done())]
                await asyncio.wait(
                    pending if directing is None else [*pending, directing],
                    timeout=None if deadline is None else deadline - loop.time(),
                    return_when=asyncio.FIRST_COMPLETED,
                )
                changed.cancel()
        finally:
            interrupted.cancel()

    async def end(self) -> list[_Running]:
        """Ends all that are left; returns those that had to be told to end."""
        running = list(self._running.values())
        for one in running:
            if one.stopped:  # it could not heed anything gentler
                _signal(one, signal.SIGKILL)
        await _stop([one for one in running if one.row.ends == "by itself"], STOP_S)
        told = [one for one in running if one.row.ends != "by itself"]
        await _stop(told, STOP_RECORDER_S)
        await asyncio.gather(*self._readers)
        return [one for one in told if one.row.ends == "when told"]


async def _stop(running: list[_Running], patience_s: float) -> None:
    """SIGTERM, then SIGKILL for those that do not heed it, then for whatever they left in their sessions."""
    left = [one for one in running if not one.ended.done()]
    for one in left:
        _signal(one, signal.SIGTERM)
        _signal(one, signal.SIGCONT)  # who was stopped could not heed it
        one.halted = ""
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
def _signals(handlers: dict[signal.Signals, Callable[[], None]]) -> Iterator[None]:
    """Afterwards the signals do what they did before."""
    loop, before = asyncio.get_running_loop(), {number: signal.getsignal(number) for number in handlers}
    for number, handler in handlers.items():
        loop.add_signal_handler(number, handler)
    try:
        yield
    finally:
        for number in handlers:
            loop.remove_signal_handler(number)
            signal.signal(number, before[number])
