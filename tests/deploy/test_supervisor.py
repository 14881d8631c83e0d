"""Does every process of a run end, whatever happens to it or to the launcher? With real processes and real signals."""

import contextlib
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from deploy import supervisor
from deploy.fleet import Process
from deploy.supervisor import Outcome

# Tells its number, and that it is ready to be signalled.
READY = "import os, signal, sys; print(os.getpid(), flush=True); "
WAIT = READY + "signal.pause()"
STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); " + READY + "\nwhile True: signal.pause()"
NOTED = "import signal, sys; signal.signal(signal.SIGTERM, lambda *_: sys.exit(0)); " + WAIT


def row(name: str, program: str, ends: str = "by itself") -> Process:
    return Process(name, (sys.executable, "-S", "-c", program), ends, reports=True)  # type: ignore[arg-type]


def await_end(pid: int) -> None:
    """Returns once the process has ended, whether or not its parent has taken notice."""
    with contextlib.suppress(ProcessLookupError):
        descriptor = os.pidfd_open(pid)
        select.select([descriptor], [], [])
        os.close(descriptor)


class Crew:
    """Runs a table; `act` is called with the numbers of the processes once all are ready."""

    def __init__(self, logs: Path) -> None:
        self.logs, self.pids = logs, []
        self._before = set(psutil.Process().children(recursive=True))  # multiprocessing may have its own

    def run(self, *table: Process, act: Callable[[list[int]], None] = lambda _: None) -> Outcome:
        def ready(line: bytes) -> None:
            self.pids.append(int(line))
            if len(self.pids) == len(table):
                act(self.pids)

        return supervisor.run(table, self.logs, ready)

    def assert_none_left(self) -> None:
        assert not [pid for pid in self.pids if psutil.pid_exists(pid)]
        assert set(psutil.Process().children(recursive=True)) <= self._before


@pytest.fixture
def crew(tmp_path: Path) -> Crew:
    return Crew(tmp_path)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """For those that would be waited for in vain."""
    monkeypatch.setattr(supervisor, "STOP_S", 0.1)
    monkeypatch.setattr(supervisor, "TOGETHER_S", 0.1)


def test_a_run_that_ends_by_itself_ends_well_and_then_the_recorder_is_told(crew: Crew) -> None:
    last = "import signal, sys; signal.signal(signal.SIGTERM, lambda *_: (print(0, flush=True), sys.exit(0))); "
    lines: list[bytes] = []
    table = (row("recorder", last + WAIT, "when told"), row("world", READY), row("mav_1", READY))
    outcome = supervisor.run(table, crew.logs, lines.append)
    assert outcome == Outcome()
    assert lines[-1] == b"0\n"  # after the others
    assert len(lines) == 4
    crew.assert_none_left()


def test_children_do_their_algebra_in_one_thread(crew: Crew) -> None:
    program = "import os; print(os.environ['OPENBLAS_NUM_THREADS'], flush=True)"
    lines: list[bytes] = []
    supervisor.run((row("world", program),), crew.logs, lines.append)
    assert lines == [b"1\n"]


def test_an_exit_status_ends_the_run_with_the_last_words(crew: Crew) -> None:
    failing = READY + "sys.stderr.write('Traceback\\nValueError: it broke\\n\\n'); sys.exit(3)"
    outcome = crew.run(row("recorder", NOTED, "when told"), row("world", WAIT), row("mav_1", failing))
    log = crew.logs / "mav_1.txt"
    assert outcome.failure == f"mav_1 ended early (exit status 3): ValueError: it broke (log: {log})"
    crew.assert_none_left()


def test_a_process_that_is_killed_ends_the_run(crew: Crew) -> None:
    def kill(pids: list[int]) -> None:
        os.kill(pids[1], signal.SIGKILL)

    outcome = crew.run(row("world", WAIT), row("mav_1", WAIT), act=kill)
    assert outcome.failure is not None
    assert "ended early (killed by SIGKILL)" in outcome.failure
    crew.assert_none_left()


def test_a_recorder_that_ends_before_it_is_told_ends_the_run(crew: Crew) -> None:
    outcome = crew.run(row("recorder", READY, "when told"), row("world", WAIT))
    assert outcome.failure is not None
    assert outcome.failure.startswith("recorder ended early (exit status 0)")
    crew.assert_none_left()


@pytest.mark.usefixtures("impatient")
def test_one_that_leaves_the_others_waiting_is_named(crew: Crew) -> None:
    outcome = crew.run(row("world", WAIT), row("mav_1", READY))
    assert outcome.failure is not None
    assert outcome.failure.startswith("mav_1 ended, but 0.1 s later these had not: world (log: ")
    crew.assert_none_left()


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_all_also_those_that_do_not_heed_sigterm_or_are_frozen(crew: Crew, number: signal.Signals) -> None:
    def interrupt(pids: list[int]) -> None:
        os.kill(pids[-1], signal.SIGSTOP)
        os.kill(os.getpid(), number)

    table = (row("recorder", NOTED, "when told"), row("world", STUBBORN), row("mav_1", STUBBORN), row("mav_2", WAIT))
    assert crew.run(*table, act=interrupt) == Outcome(interrupted=True)
    crew.assert_none_left()


def test_ctrl_c_while_processes_start_starts_no_more(crew: Crew) -> None:
    """The first process interrupts the launcher itself, as early as it can."""
    program = "import os, signal; os.kill(os.getppid(), signal.SIGINT); signal.pause()"
    rows = [row("world", program), *(row(f"mav_{mav}", WAIT) for mav in range(1, 30))]
    assert crew.run(*rows) == Outcome(interrupted=True)
    crew.assert_none_left()


@pytest.mark.usefixtures("impatient")  # the grandchild keeps its parent's output open
def test_grandchildren_go_too(crew: Crew) -> None:
    parent = (
        f"import subprocess, sys, signal; subprocess.Popen([sys.executable, '-S', '-c', {STUBBORN!r}]); signal.pause()"
    )

    def interrupt(pids: list[int]) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    assert crew.run(row("world", parent), act=interrupt) == Outcome(interrupted=True)
    assert len(crew.pids) == 1
    await_end(crew.pids[0])  # or this test would not


def test_a_killed_launcher_takes_its_processes_with_it(tmp_path: Path) -> None:
    program = f"""
import sys
from pathlib import Path
from deploy import supervisor
from tests.deploy.test_supervisor import STUBBORN, row
table = (row("world", STUBBORN), row("mav_1", STUBBORN))
supervisor.run(table, Path({str(tmp_path)!r}), lambda line: print(int(line), flush=True))
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as launcher:
        assert launcher.stdout is not None
        children = [int(launcher.stdout.readline()) for _ in range(2)]
        launcher.kill()
    for pid in children:
        await_end(pid)  # or this test would not


class Halting:
    """Stops from outside who is ready first, and does something as soon as the supervisor has noticed."""

    def __init__(self, act: Callable[[list[int], str], None]) -> None:
        self.act, self.pids, self.said = act, [], []

    def run(self, logs: Path, *table: Process) -> Outcome:
        def ready(line: bytes) -> None:
            self.pids.append(int(line))
            if len(self.pids) == len(table):
                os.kill(self.pids[0], signal.SIGSTOP)

        def say(words: str) -> None:
            self.said.append(words)
            self.act(self.pids, words)

        return supervisor.run(table, logs, ready, say=say)


def test_who_is_stopped_from_outside_is_named_and_goes_on(crew: Crew) -> None:
    def let_it_go_on(pids: list[int], words: str) -> None:
        os.kill(pids[0], signal.SIGTERM if words == "mav_1 goes on" else signal.SIGCONT)

    halting = Halting(let_it_go_on)
    assert halting.run(crew.logs, row("mav_1", NOTED)) == Outcome()
    pid = halting.pids[0]
    assert halting.said == [f"mav_1 was stopped by SIGSTOP; kill -CONT {pid} lets it go on", "mav_1 goes on"]


def test_what_others_do_meanwhile_is_put_down_to_who_is_stopped(crew: Crew) -> None:
    halting = Halting(lambda pids, _: os.kill(pids[1], signal.SIGKILL))
    outcome = halting.run(crew.logs, row("recorder", NOTED, "when told"), row("world", WAIT))
    assert outcome.failure is not None
    stopped = halting.said[0].partition(" ")[0]
    (killed,) = {"recorder", "world"} - {stopped}
    assert outcome.failure.startswith(
        f"{stopped} was stopped by SIGSTOP; then {killed} ended early (killed by SIGKILL)"
    )


def test_who_is_stopped_is_continued_when_all_are_to_end(crew: Crew) -> None:
    last = (
        "import signal, sys; signal.signal(signal.SIGTERM, lambda *_: open(sys.argv[1], 'w').close() or sys.exit(0));"
    )
    heeding = row("recorder", last + WAIT, "when told")
    recorder = replace(heeding, command=(*heeding.command, str(crew.logs / "saved")))
    halting = Halting(lambda *_: os.kill(os.getpid(), signal.SIGINT))
    assert halting.run(crew.logs, recorder, row("world", WAIT)) == Outcome(interrupted=True)
    assert (crew.logs / "saved").exists()
    assert len(halting.said) == 1


@pytest.mark.usefixtures("impatient")
def test_a_display_that_fails_ends_the_run_and_is_heard_of(crew: Crew) -> None:
    def fail(pids: list[int]) -> None:
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        crew.run(row("recorder", NOTED, "when told"), row("world", WAIT), act=fail)
    crew.assert_none_left()


@pytest.mark.parametrize("ending", [READY + "sys.exit(1)", READY, WAIT, STUBBORN])
def test_one_that_may_end_whenever_it_likes_does_not_decide_over_the_run(
    ending: str, crew: Crew, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "STOP_RECORDER_S", 0.5)
    monkeypatch.setattr(supervisor, "READY_S", 0.1)

    def tell_the_other(pids: list[int]) -> None:
        for pid in pids:
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it is no more
                if "viewer" not in Path(f"/proc/{pid}/cmdline").read_text():
                    os.kill(pid, signal.SIGTERM)

    table = (row("mav_1", NOTED), row("viewer", ending + "  # viewer", ends="whenever"))
    assert crew.run(*table, act=tell_the_other) == Outcome()
    crew.assert_none_left()


def test_the_others_begin_when_it_is_ready(crew: Crew) -> None:
    """Each notes when it begins; the first says that it is ready only once it has noted something itself."""
    note = f"open({str(crew.logs / 'order')!r}, 'a').write"
    viewer = f"{note}('viewer '); print('ready', flush=True); import signal; signal.pause()"
    table = (row("viewer", viewer, ends="whenever"), row("mav_1", f"{note}('mav_1')"))
    assert supervisor.run(table, crew.logs, lambda _: None) == Outcome()
    assert (crew.logs / "order").read_text() == "viewer mav_1"


def test_after_a_run_signals_do_what_they_did_before(crew: Crew) -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        for number in before:
            signal.signal(number, signal.default_int_handler)
        crew.run(row("world", READY))
        assert {signal.getsignal(number) for number in before} == {signal.default_int_handler}
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
