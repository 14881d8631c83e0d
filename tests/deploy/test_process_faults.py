"""Do kills, stops and restarts happen to real processes as to those in one process, and does every run end?"""

import asyncio
import json
import os
import signal
from pathlib import Path

import msgpack
import psutil
import pytest

from agent.interface import clock
from agent.interface.bus import Packet
from agent.interface.fleet import Fleet
from deploy import composition, supervisor
from deploy.experiment import Experiment, load
from deploy.faults import Faults, ProcessFault
from deploy.log import read_log
from deploy.process_faults import Director
from deploy.progress import Progress
from deploy.run import run
from deploy.supervisor import Outcome
from deploy.terminal import Quiet
from tests.deploy.test_supervisor import READY, WAIT, row
from world.world import STOOD_STILL_S

EXPERIMENT = """
[fleet]
mavs = 3
duration_s = {duration_s}
seed = 5
realtime = {realtime}
[[world.path]]
formation = "box"
size_m = [6.0, 6.0, 2.0]
hold_s = 10.0
"""


def faults(*verbs: tuple[float, str, int]) -> str:
    return "".join(f"[[faults.processes]]\nat_s = {at_s}\ndo = '{do}'\nmav = {mav}\n" for at_s, do, mav in verbs)


def experiment(folder: Path, schedule: str, duration_s: float, realtime: bool = False) -> Experiment:
    text = EXPERIMENT.format(duration_s=duration_s, realtime=str(realtime).lower()) + schedule
    (folder / "faulty.toml").write_text(text)
    return load(str(folder / "faulty.toml"))


def said(packets: list[Packet]) -> list[str]:
    """Everything but what things cost, without the number of the run; in no order."""
    unpacked = [(key, msgpack.unpackb(payload)) for key, payload in packets if not key.startswith("status/")]
    return sorted(f"{key} {[fields[0], *fields[2:]]}" for key, fields in unpacked)


@pytest.mark.system
def test_the_same_seed_gives_the_same_as_in_one_process_whoever_dies(tmp_path: Path) -> None:
    schedule = faults((0.4, "join", 1), (0.8, "kill", 2), (1.4, "restart", 2), (1.8, "stop", 3), (2.4, "continue", 3))
    flown = experiment(tmp_path, schedule, duration_s=3.0)
    in_one: list[Packet] = []
    composition.fly(flown, 2**30, in_one.extend)
    assert run(flown, tmp_path / "run", False, Quiet()).outcome == Outcome()
    assert said(read_log(tmp_path / "run" / "log.mcap").packets) == said(in_one)
    assert not (tmp_path / "run" / "logs" / "recorder.txt").read_text()  # nothing is missing that should be there


class Watching(Quiet):
    """Stops the world once, lets it go on when it must notice and all agents hold, and ends the run when none does."""

    def __init__(self) -> None:
        self.stopped_s: float | None = None
        self.before = psutil.Process().children(recursive=True)
        self.held = self.went_on = False

    def children(self) -> list[psutil.Process]:
        return [child for child in psutil.Process().children(recursive=True) if child not in self.before]

    def world(self) -> psutil.Process:
        (world,) = (child for child in self.children() if child.cmdline()[2:3] == ["world"])
        return world

    def show(self, progress: Progress) -> None:
        if progress.sim_s > 0.2 and self.stopped_s is None:
            self.stopped_s = clock.now_s()
            self.world().send_signal(signal.SIGSTOP)
        long = self.stopped_s is not None and clock.now_s() > self.stopped_s + STOOD_STILL_S + 0.5
        if long and all(mav.holding for mav in progress.mavs) and not self.held:
            self.held = True
            self.world().send_signal(signal.SIGCONT)
        if self.held and not self.went_on and not any(mav.holding for mav in progress.mavs):
            self.went_on = True
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.system
def test_agents_hold_while_the_world_is_stopped_and_go_on_with_it(tmp_path: Path) -> None:
    watching = Watching()
    outcome, summary = run(experiment(tmp_path, "", 60.0, realtime=True), tmp_path / "run", False, watching)
    assert (outcome, watching.held, watching.went_on) == (Outcome(interrupted=True), True, True)
    assert not watching.children()
    assert summary is not None
    logs = {path.stem: path.read_text() for path in (tmp_path / "run" / "logs").iterdir()}
    assert "stood still for" in logs["world"]
    assert all("its own sensors are back after" in logs[f"mav_{mav}"] for mav in (1, 2, 3))


class UntilAllAreBack(Quiet):
    """Ends a run once MAV 3 has seen two neighbours go and come back."""

    def __init__(self) -> None:
        self.gone: set[int] = set()
        self.back = False

    def show(self, progress: Progress) -> None:
        self.gone |= set(progress.mavs[2].gone)
        if self.gone == {1, 2} and not (progress.mavs[2].gone or progress.mavs[2].stale):
            self.back = True
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.system
def test_in_real_time_neighbours_go_and_come_back(tmp_path: Path) -> None:
    """One is killed and restarted, one stopped and continued."""
    schedule = faults((0.5, "kill", 1), (0.6, "stop", 2), (0.7, "restart", 1), (4.0, "continue", 2))
    before = psutil.Process().children(recursive=True)
    until = UntilAllAreBack()
    outcome, summary = run(experiment(tmp_path, schedule, 60.0, realtime=True), tmp_path / "run", False, until)
    assert (outcome, until.back) == (Outcome(interrupted=True), True)
    assert psutil.Process().children(recursive=True) == before
    assert summary is not None
    assert [mav["restarts"] for mav in summary["mavs"]] == [1, 0, 0]
    packets = read_log(tmp_path / "run" / "log.mcap").packets
    journal = [(key.split("/")[1], msgpack.unpackb(payload)[5]) for key, payload in packets if "/process" in key]
    assert journal == [("1", "kill"), ("2", "stop"), ("1", "restart"), ("2", "continue")]


def test_a_director_has_the_dead_not_mourned_and_the_stopped_not_awaited(tmp_path: Path) -> None:
    """The world holds before ticks 1 and 2; MAV 1 is killed, MAV 2 stopped to the end, MAV 3 joins."""
    world = (
        "import sys; print('ready', flush=True); said = [sys.stdin.readline()]\n"
        "for tick in (1, 2): print('{\"held\": %d}' % tick, flush=True); said.append(sys.stdin.readline())\n"
        "open(sys.argv[1], 'w').writelines(said)"
    )
    table = (
        row("recorder", "print('ready', flush=True); import sys; [*sys.stdin]", "when told"),
        supervisor.Process("world", (*row("", world).command, str(tmp_path / "said")), "by itself"),
        *(row(f"mav_{mav}", "print('ready', flush=True); " + WAIT) for mav in (1, 2)),
        row("mav_3", "print('ready', flush=True); import sys; print(sys.argv[1:], flush=True)"),
    )
    verbs = (ProcessFault(mav=1, do="kill", at_s=0.1), ProcessFault(mav=2, do="stop", at_s=0.2))
    director = Director(Faults(processes=(*verbs, ProcessFault(mav=3, do="join", at_s=0.2))), Fleet(mavs=3))
    lines: list[bytes] = []
    halts: list[str] = []
    outcome = supervisor.run(table, tmp_path, lines.append, director, halts.append)
    assert not halts  # they are the director's
    assert outcome.failure is not None  # this recorder does not survive SIGTERM
    assert outcome.failure.startswith("recorder ended early (killed by SIGTERM)")
    assert [json.loads(text) for text in (tmp_path / "said").read_text().splitlines()] == [
        {"roll": [[1, 0], [2, 0]], "until": 1, "absent": [3]},
        {"roll": [[2, 0]], "until": 2, "absent": [1, 3]},
        {"roll": [[3, 0]], "until": None, "absent": [1]},
    ]
    assert b"['--incarnation', '0', '--meet', 'recorder,world']\n" in lines
    for pid in (int(text) for text in lines if text.strip().isdigit()):
        assert not psutil.pid_exists(pid)


def test_one_that_dies_undirected_is_still_a_failure(tmp_path: Path) -> None:
    suicide = f"print('ready', flush=True); {READY}os.kill(os.getpid(), signal.SIGKILL)"
    table = (row("world", "print('ready', flush=True); " + WAIT), row("mav_1", suicide))
    director = Director(Faults(processes=(ProcessFault(mav=1, do="kill", at_s=3.0),)), Fleet(mavs=1))
    outcome = supervisor.run(table, tmp_path, lambda _: None, director)
    assert outcome.failure is not None
    assert outcome.failure.startswith("mav_1 ended early (killed by SIGKILL)")


def test_in_real_time_the_run_s_own_time_decides() -> None:
    """What the recorder reports; when that stands still, so does the schedule."""

    class Silent:
        def __init__(self) -> None:
            self.done: list[str] = []

        async def all_ready(self) -> None:
            pass

        async def kill(self, name: str) -> None:
            self.done.append(name)

        def tell(self, name: str, line: bytes) -> None:
            pass

    async def direct() -> tuple[list[str], list[str]]:
        fleet = Fleet(mavs=1, realtime=True)
        director, crew = Director(Faults(processes=(ProcessFault(mav=1, do="kill", at_s=1000.0),)), fleet), Silent()
        task = asyncio.create_task(director.direct(crew))  # type: ignore[arg-type]
        for sim_s in (0.0, 10.0, 999.0):
            director.heard("recorder", json.dumps({"sim_s": sim_s}).encode())
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        before = list(crew.done)
        director.heard("recorder", b'{"sim_s": 1000.0}')
        await task
        return before, crew.done

    assert asyncio.run(direct()) == ([], ["mav_1"])
