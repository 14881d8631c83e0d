"""Which processes make a run? One row each: its command, its place in the mesh, and how it ends."""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from agent.interface.bus import Network
from agent.interface.fleet import Fleet

HIDDEN_FROM_AGENTS = ("truth/**", "fault/**")


@dataclass(frozen=True)
class Process:
    """A row of the table. Nobody waits to be started: all come up at once and find each other (`process.meet`)."""

    name: str
    command: tuple[str, ...]
    ends: Literal["by itself", "when told"]  # when told: by SIGTERM, after all that end by themselves
    reports: bool = False  # its standard output is progress (JSON lines); everything else it says goes to its log


def processes(fleet: Fleet, run: Path, sockets: Path, epoch: int, impaired: bool = False) -> tuple[Process, ...]:
    """The table of a run; writes each one's network file into `sockets`.

    Args:
        run: the run folder, with experiment.toml in it.
        sockets: a directory with a short path, for a unix socket's is limited to some 108 characters.
        epoch: the number of the run.
        impaired: whether there are faults in the experiment: then the agents' buses are wrapped.
    """
    names = ("recorder", "world", *(f"mav_{mav}" for mav in fleet.ids))
    places = {name: f"unixsock-stream/{sockets}/{name}" for name in names}
    for index, name in enumerate(names):
        network = Network(
            name=name,
            namespace=f"swarm/{epoch}",
            listen=(places[name],),
            connect=tuple(places[other] for other in names[:index]),
            lossless=not fleet.realtime,
            deny=HIDDEN_FROM_AGENTS if name.startswith("mav_") else (),
        )
        (sockets / f"{name}.json").write_text(json.dumps(asdict(network) | {"everyone": names}))

    def command(module: str, name: str, *more: str) -> tuple[str, ...]:
        network = str(sockets / f"{name}.json")
        start = (str(run / "experiment.toml"), "--network", network, "--epoch", str(epoch))
        return (sys.executable, "-m", module, *start, *more)

    agent = "deploy.impaired_agent" if impaired else "agent"
    return (
        Process("recorder", command("deploy.recorder", "recorder"), ends="when told", reports=True),
        Process("world", command("world", "world"), ends="by itself"),
        *(
            Process(f"mav_{mav}", command(agent, f"mav_{mav}", "--mav", str(mav)), ends="by itself")
            for mav in fleet.ids
        ),
    )
