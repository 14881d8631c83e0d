"""How does a process of the swarm start and stop? Arguments, meeting the others, signals.

`deploy` starts every process the same way: the resolved experiment, a network file and the run's epoch.
"""

import argparse
import json
import logging
import signal
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import msgspec

from agent.interface.bus import Network, ZenohBus
from agent.interface.fleet import Fleet
from agent.interface.tables import BadExperiment, parse_table

START_TIMEOUT_S = 60.0  # eight processes that import numpy at once on two busy cores took 25 s


class Start(NamedTuple):
    """What a process is started with."""

    experiment: dict[str, Any]
    fleet: Fleet
    network: Network
    everyone: tuple[str, ...]  # the names of all processes of the run, this one included
    epoch: int
    mav: int  # 0 for a process that is not an agent


def arguments(program: str) -> Start:
    """Reads the command line of `python -m agent`, `python -m world` and the recorder.

    Raises:
        BadExperiment: the experiment file's [fleet] table is wrong.
    """
    parser = argparse.ArgumentParser(prog=program, description="One process of a swarm; `swarm run` starts them all.")
    parser.add_argument("experiment", type=Path, help="resolved experiment (TOML)")
    parser.add_argument("--network", type=Path, required=True, help="endpoints of this process (JSON)")
    parser.add_argument("--epoch", type=int, required=True, help="number of the run; others' messages are ignored")
    parser.add_argument("--mav", type=int, default=0, help="which MAV this agent is, 1..N")
    chosen = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    experiment = tomllib.loads(chosen.experiment.read_text())
    fleet = parse_table(Fleet, experiment["fleet"], "fleet")
    place = json.loads(chosen.network.read_text())
    everyone = tuple(place.pop("everyone"))
    network = msgspec.convert(place, Network)
    if chosen.mav not in (0, *fleet.ids):
        raise BadExperiment(f"--mav {chosen.mav}: expected 1 to {fleet.mavs}")
    return Start(experiment, fleet, network, everyone, chosen.epoch, chosen.mav)


def stop_on_signals() -> None:
    """SIGTERM unwinds the program through its `with` blocks, also out of a blocking receive; Ctrl-C is deploy's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _exit)


def _exit(*_: object) -> NoReturn:
    raise SystemExit(128 + signal.SIGTERM)


def meet(bus: ZenohBus, everyone: tuple[str, ...], epoch: int) -> None:
    """Returns when every process of the run has a link to every other; declare subscriptions before.

    A token is visible over a link only after the subscriptions declared before it, so nothing that is published
    afterwards can be lost for want of a subscriber.

    Raises:
        BusError: some process did not come in time.
    """
    me, others = bus.network.name, [name for name in everyone if name != bus.network.name]
    for stage in ("here", "linked"):
        bus.announce(f"alive/{me}/{epoch}/{stage}")
        bus.await_alive([f"alive/{name}/{epoch}/{stage}" for name in others], START_TIMEOUT_S)
