"""How does a process of the swarm start and stop? Arguments, joining the others, signals.

`deploy` starts every process the same way: the resolved experiment, a network file and the run's epoch.
"""

import argparse
import contextlib
import json
import logging
import secrets
import signal
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import msgspec

from agent.interface.bus import BusError
from agent.interface.fleet import Fleet
from agent.interface.presence import LINKED, RANDOM, Claim, Presence, meet, occupant
from agent.interface.tables import BadExperiment, parse_table
from agent.interface.zenoh_bus import Network, ZenohBus

READY = b"ready"  # what a process says on its standard output once it has met the others
START_TIMEOUT_S = 60.0  # eight processes that import numpy at once on two busy cores took 25 s


class Start(NamedTuple):
    """What a process is started with."""

    experiment: dict[str, Any]
    fleet: Fleet
    network: Network
    others: tuple[str, ...]  # the names of the processes that it waits for
    epoch: int
    mav: int  # 0 for a process that is not an agent
    incarnation: int
    patience_s: float  # how long it waits for them


def arguments(program: str, words: list[str] | None = None) -> Start:
    """Reads the command line of `python -m agent`, `python -m world` and the recorder.

    Args:
        words: the command line; None: this process's own.

    Raises:
        BadExperiment: the experiment file's [fleet] table is wrong.
    """
    parser = argparse.ArgumentParser(prog=program, description="One process of a swarm; `swarm run` starts them all.")
    parser.add_argument("experiment", type=Path, help="resolved experiment (TOML)")
    parser.add_argument("--network", type=Path, required=True, help="endpoints of this process (JSON)")
    parser.add_argument("--epoch", type=int, required=True, help="number of the run; others' messages are ignored")
    parser.add_argument("--mav", type=int, default=0, help="which MAV this agent is, 1..N")
    parser.add_argument("--incarnation", default="random", help="how many it has had before, or random (default)")
    parser.add_argument("--patience", type=float, default=START_TIMEOUT_S, help="s that it waits for the others")
    parser.add_argument("--meet", help="names of the processes to wait for, as in world,mav_2 (default: everyone)")
    chosen = parser.parse_args(words)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    experiment = tomllib.loads(chosen.experiment.read_text())
    fleet = parse_table(Fleet, experiment["fleet"], "fleet")
    place = json.loads(chosen.network.read_text())
    everyone = place.pop("everyone")
    network = msgspec.convert(place, Network)
    names = everyone if chosen.meet is None else chosen.meet.split(",")
    others = tuple(name for name in names if name not in ("", network.name))
    incarnation = secrets.choice(RANDOM) if chosen.incarnation == "random" else int(chosen.incarnation)
    if chosen.mav not in (0, *fleet.ids):
        raise BadExperiment(f"--mav {chosen.mav}: expected 1 to {fleet.mavs}")
    return Start(experiment, fleet, network, others, chosen.epoch, chosen.mav, incarnation, chosen.patience)


def stop_on_signals() -> None:
    """SIGTERM unwinds the program through its `with` blocks, also out of a blocking receive; Ctrl-C is deploy's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _exit)


def _exit(*_: object) -> NoReturn:
    raise SystemExit(128 + signal.SIGTERM)


@contextlib.contextmanager
def on_the_bus(start: Start) -> Iterator[ZenohBus]:
    """This process's place on the network, left on every way out.

    Raises:
        BusError: it cannot be had; it says so if another process of the same name has it.
    """
    try:
        bus = ZenohBus(start.network)
    except BusError:
        already = occupant(start.network)
        if already is None:
            raise
        raise BusError(f"{start.network.name}: {already}, at {', '.join(start.network.listen)}") from None
    with bus:
        yield bus


def join(start: Start, bus: ZenohBus, witness: bool = False) -> Presence:
    """Meets the others; subscribe before. Then it says on its standard output that it is ready, for who started it.

    Raises:
        AlreadyHere: somebody else has the same name.
        BusError: some process did not come in time.
    """
    presence = Presence(bus, start.epoch, start.incarnation, witness)
    meet(presence, start.others, start.patience_s)
    print(READY.decode(), flush=True)
    return presence


def meet_agents(bus: ZenohBus, epoch: int, incarnations: Iterable[tuple[int, int]]) -> None:
    """Returns when these MAVs hear what is published; each is given with its incarnation.

    Raises:
        BusError: some of them did not come in time.
    """
    bus.await_alive([Claim(f"mav_{mav}", epoch, number).key(LINKED) for mav, number in incarnations], START_TIMEOUT_S)
