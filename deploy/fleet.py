"""Which processes make a run? One row each: its command, its place in the mesh, and how it ends."""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from agent.interface.fleet import Fleet
from agent.interface.zenoh_bus import Network
from deploy.faults import Faults

VIEWER = "viewer"
HIDDEN_FROM_AGENTS = ("truth/**", "fault/**")


@dataclass(frozen=True)
class Place:
    """Where a process is in the network."""

    listen: str  # the Zenoh endpoint at which it listens
    reach: str = ""  # at which the others reach it, if that is another
    inside: tuple[str, ...] = ()  # what its command is run by, as in ("ip", "netns", "exec", "left")


@dataclass(frozen=True)
class Process:
    """A row of the table. Nobody waits to be started: all come up at once and find each other (`process.join`)."""

    name: str
    command: tuple[str, ...]
    # When told: by SIGTERM, after all that end by themselves. Whenever: the same, but the run does without it, too; who
    # comes after it is started when it is ready.
    ends: Literal["by itself", "when told", "whenever"]
    reports: bool = False  # its standard output is progress (JSON lines); everything else it says goes to its log


def names(fleet: Fleet) -> tuple[str, ...]:
    return ("recorder", "world", *(f"mav_{mav}" for mav in fleet.ids))


def on_one_host(fleet: Fleet, sockets: Path) -> dict[str, Place]:
    """Unix sockets in a directory with a short path: theirs are limited to some 108 characters."""
    return {name: Place(f"unixsock-stream/{sockets}/{name}") for name in names(fleet)}


def processes(
    fleet: Fleet,
    run: Path,
    networks: Path,
    epoch: int,
    places: dict[str, Place],
    faults: Faults,
    view: str | None = None,
) -> tuple[Process, ...]:
    """The table of a run; writes each one's network file into `networks`.

    Args:
        run: the run folder, with experiment.toml in it.
        epoch: the number of the run.
        places: where each process is, by name; one that is nowhere is not part of the run.
        faults: if there are any, the agents' buses are wrapped.
        view: where a viewer listens, if one is to see the run.
    """
    everyone = [name for name in names(fleet) if name in places]
    late = {f"mav_{mav}" for mav in faults.late}
    there = [name for name in everyone if name not in late]
    for index, name in enumerate([*everyone, *([VIEWER] if view else [])]):
        network = Network(
            name=name,
            namespace=f"swarm/{epoch}",
            listen=() if name == VIEWER else (places[name].listen,),
            connect=tuple(places[other].reach or places[other].listen for other in everyone[:index]),
            lossless=not fleet.realtime,
            deny=HIDDEN_FROM_AGENTS if name.startswith("mav_") else (),
        )
        (networks / f"{name}.json").write_text(json.dumps(asdict(network) | {"everyone": there}))

    def command(module: str, name: str, *more: str) -> tuple[str, ...]:
        start = (str(run / "experiment.toml"), "--network", str(networks / f"{name}.json"), "--epoch", str(epoch))
        inside = places[name].inside if name in places else ()
        return (*inside, sys.executable, "-m", module, *start, "--incarnation", "0", *more)

    agent = "deploy.impaired_agent" if faults.present else "agent"
    rows = []
    for name in everyone:
        if name == "recorder":
            rows.append(Process(name, command("deploy.recorder", name), ends="when told", reports=True))
        elif name == "world":
            rows.append(Process(name, command("world", name), ends="by itself"))
        else:
            mav = name.removeprefix("mav_")
            rows.append(Process(name, command(agent, name, "--mav", mav), ends="by itself"))
    if view:  # nobody connects to it
        rows.insert(0, Process(VIEWER, command("deploy.view.live", VIEWER, "--to", view), ends="whenever"))
    return tuple(rows)
