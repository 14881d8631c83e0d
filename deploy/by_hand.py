"""How is one process of a run started by hand, on one of several hosts? `swarm agent`, `swarm world`, `swarm recorder`.

All hosts need the same experiment file, the same epoch and the same table of endpoints, a TOML file with a line for
each process: `world = "tcp/192.168.1.10:7447"`, `mav_1 = ...`. The recorder may be left out; in real time the world,
too, where drivers take its place.
"""

import re
import subprocess
import tempfile
import tomllib
from functools import partial
from os import getpid
from pathlib import Path

import msgspec

from agent.interface.tables import BadExperiment
from deploy import fleet
from deploy.experiment import UNREADABLE, Experiment
from deploy.fleet import Place, Process
from deploy.leash import die_with
from deploy.progress import Progress
from deploy.terminal import Display

# Of Zenoh: protocol, host and port, then what it calls metadata and configuration; or a Unix socket.
ENDPOINT = re.compile(
    r"(tcp|udp|tls|quic|ws)/(\[[0-9a-fA-F:.]+(%\w+)?\]|[^\s/:?#\[\]]+):(?P<port>[0-9]{1,5})([?#]\S*)?|unixsock-stream/\S+"
)
PATIENCE_S = 3600.0  # that the processes on the other hosts may take to come


def places(path: Path, experiment: Experiment) -> dict[str, Place]:
    """Where every process of this experiment is.

    Raises:
        BadExperiment: no such file, not TOML, a process without an endpoint, or one that is not part of the run; or the
            experiment wants processes killed, which nobody here would do.
    """
    if experiment.faults.processes:
        raise BadExperiment("faults.processes: expected none, by hand nobody carries them out (`swarm run` does)")
    try:
        table = tomllib.loads(path.read_text())
    except (OSError, *UNREADABLE) as error:
        raise BadExperiment(f"--network {path}: cannot be read as TOML: {error}") from None
    known = fleet.names(experiment.fleet)
    for name in known:
        if name not in table and name not in (("recorder", "world") if experiment.fleet.realtime else ("recorder",)):
            raise BadExperiment(f"--network {path}: {name} is missing, expected an endpoint as in tcp/10.0.0.1:7447")
    for name, endpoint in table.items():
        if name not in known:
            raise BadExperiment(f"--network {path}: {name}: there is no such process, expected {', '.join(known)}")
        found = ENDPOINT.fullmatch(endpoint) if isinstance(endpoint, str) else None
        if found is None or int(found["port"] or 1) not in range(1, 65536):
            raise BadExperiment(f"--network {path}: {name} = {endpoint!r}: expected as in 'tcp/10.0.0.1:7447'")
        other = next(each for each in table if table[each] == endpoint)
        if other != name:
            raise BadExperiment(
                f"--network {path}: {name} = {endpoint!r}: {other} has the same, expected one of its own"
            )
    return {name: Place(endpoint) for name, endpoint in table.items()}


def run(experiment: Experiment, where: dict[str, Place], name: str, epoch: int) -> int:
    """One agent or the world, until the run ends or Ctrl-C; its exit status."""
    with tempfile.TemporaryDirectory(prefix="swarm-") as folder:
        (Path(folder) / "experiment.toml").write_text(experiment.toml())
        row = _row(experiment, where, name, epoch, Path(folder), Path(folder))
        with _started(row) as child:
            return _wait(child)


def record(experiment: Experiment, where: dict[str, Place], epoch: int, folder: Path, display: Display) -> int:
    """The recorder, until Ctrl-C: the others do not tell it when they have ended."""
    (folder / "experiment.toml").write_text(experiment.toml())
    with tempfile.TemporaryDirectory(prefix="swarm-") as networks:
        row = _row(experiment, where, "recorder", epoch, folder.resolve(), Path(networks))
        with display, _started(row, stdout=subprocess.PIPE) as child:
            assert child.stdout is not None
            try:
                for line in child.stdout:
                    if line.startswith(b"{"):
                        display.show(msgspec.json.decode(line, type=Progress))
            except KeyboardInterrupt:
                child.terminate()
            return child.wait()


def _row(
    experiment: Experiment, where: dict[str, Place], name: str, epoch: int, run_folder: Path, networks: Path
) -> Process:
    table = fleet.processes(experiment.fleet, run_folder, networks, epoch, where, experiment.faults)
    rows = {row.name: row for row in table}
    if name not in rows:
        raise BadExperiment(f"{name}: it has no endpoint in the --network file")
    return rows[name]


def _started(row: Process, stdout: int | None = None) -> "subprocess.Popen[bytes]":
    # Its incarnation is its own: nobody counts them here.
    words = [*row.command, "--incarnation", "random", "--patience", str(PATIENCE_S)]
    return subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=stdout, preexec_fn=partial(die_with, getpid()))


def _wait(child: "subprocess.Popen[bytes]") -> int:
    try:
        return child.wait()
    except KeyboardInterrupt:
        child.terminate()
        child.wait()
        raise
