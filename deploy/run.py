"""What does `swarm run` do? It makes the run folder, flies, records, scores and writes everything down."""

import contextlib
import secrets
import signal
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from agent.interface import clock
from agent.interface.bus import Packet
from agent.interface.tables import BadExperiment
from deploy import fleet, supervisor
from deploy.experiment import Experiment, from_text
from deploy.fleet import Place
from deploy.log import BadLog, LogWriter, Origin, read_log
from deploy.peek import peek
from deploy.process_faults import Director
from deploy.progress import Progress, Watch
from deploy.run_folder import CLAIM
from deploy.supervisor import Outcome
from deploy.terminal import Display

if TYPE_CHECKING:  # slow to import: a mistake in the words is answered at once
    from deploy.summary import Analysis, Circumstances

PROGRESS_S = 0.5
EPOCHS = range(2**30, 2**31)  # the messages of all runs are of the same length, which a bandwidth limit is about


class Result(NamedTuple):
    outcome: Outcome
    summary: dict[str, Any] | None  # None: nothing was recorded, or it could not be scored


class NothingRecorded(Exception):
    """The log holds no tick of the run."""


class NotScored(Exception):
    """There is a recording, but scoring it failed; the message says why, and where the log is."""


def run(
    experiment: Experiment,
    folder: Path,
    in_process: bool,
    display: Display,
    places: dict[str, Place] | None = None,
    view: str | None = None,
) -> Result:
    """Flies a checked experiment into an empty or new folder; whatever was recorded is scored, however it ended.

    Args:
        places: where the processes are, if not all on this host.
        view: where a viewer listens, if one is to see the run.
    """
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    (folder / CLAIM).write_text(experiment.toml())
    epoch = secrets.choice(EPOCHS)
    with display:
        if in_process:
            outcome = _in_process(experiment, folder, epoch, display)
        else:
            outcome = _processes(experiment, folder, epoch, display, places, view)
    display.say("scoring")
    try:
        return Result(outcome, score(folder))
    except (NothingRecorded, BadLog):
        return Result(outcome, None)
    except NotScored as error:
        words = str(error) if outcome.failure is None else f"{outcome.failure}; {error}"
        return Result(Outcome(words, outcome.interrupted), None)


class Scored(NamedTuple):
    """A run, as its log tells it."""

    analysis: "Analysis"
    circumstances: "Circumstances"
    experiment: Experiment
    resolved: str  # the experiment's text, with what it was made from and with


def scored(folder: Path) -> Scored:
    """Everything that a run folder tells, from its log.mcap alone.

    Raises:
        BadLog: there is no log.
        BadExperiment: the experiment in it is not one for this version of the programs.
        NothingRecorded: no tick of the run is in it.
    """
    from deploy import formation, summary
    from deploy.clairvoyant import replay
    from deploy.recording import assemble

    log = read_log(folder / "log.mcap")
    experiment = from_text(log.origin.experiment)
    recording = assemble(log.packets, experiment.fleet, log.origin.epoch)
    if not recording.ticks:
        raise NothingRecorded(f"{folder / 'log.mcap'}: no tick of the run was recorded")
    twin = replay(recording, experiment.agent)
    analysis = summary.analyse(recording, twin, experiment.faults, formation.mission_of(experiment.agent))
    circumstances = summary.Circumstances(experiment.name, log.origin.transport, log.wall_s)
    return Scored(analysis, circumstances, experiment, log.origin.experiment)


def score(folder: Path) -> dict[str, Any]:
    """Writes summary.json, the figures and the trajectories into a run folder; returns what is in summary.json.

    Raises:
        BadLog, BadExperiment, NothingRecorded: as `scored` does.
        NotScored: it failed in another way.
        KeyboardInterrupt: with words that say how to go on.
    """
    with _recording_is_kept(folder):
        from deploy import report, summary, tum
        from deploy.formation_figure import draw_formation

        analysis, circumstances, experiment, _ = scored(folder)
        content = summary.summarise(analysis, circumstances)
        (folder / "summary.json").write_text(summary.to_json(content))
        tum.export(analysis.recording, folder)
        report.draw_errors(analysis, experiment.name, folder / "errors.png")
        if analysis.shapes is not None:
            draw_formation(analysis, experiment.name, folder / "formation.png")
    return content


@contextlib.contextmanager
def _recording_is_kept(folder: Path) -> Iterator[None]:
    """However scoring ends, it is said where the recording is and how to score it."""
    try:
        yield
    except (BadLog, BadExperiment, NothingRecorded, OSError):  # they say it all
        raise
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{folder} is not scored yet, `swarm score {folder}` does it") from None
    except Exception as error:
        log = folder / "logs" / "scoring.txt"
        log.parent.mkdir(exist_ok=True)
        log.write_text(traceback.format_exc())
        last = f"{type(error).__name__}: {error}".splitlines()[0]
        raise NotScored(
            f"{folder} could not be scored: {last} (log: {log}); `swarm score {folder}` tries again"
        ) from None


def _processes(
    experiment: Experiment,
    folder: Path,
    epoch: int,
    display: Display,
    places: dict[str, Place] | None,
    view: str | None,
) -> Outcome:
    def show(line: bytes) -> None:
        display.show(msgspec.json.decode(line, type=Progress))

    faults = experiment.faults
    director = Director(faults, experiment.fleet) if faults.processes else None
    with tempfile.TemporaryDirectory(prefix="swarm-") as name:
        networks = Path(name)
        where = places or fleet.on_one_host(experiment.fleet, networks)
        table = fleet.processes(experiment.fleet, folder.resolve(), networks, epoch, where, faults, view)
        return supervisor.run(table, folder / "logs", show, director, display.say)


def _in_process(experiment: Experiment, folder: Path, epoch: int, display: Display) -> Outcome:
    from deploy import composition

    watch = Watch(experiment.fleet, epoch)
    shown_s = clock.now_s()
    with LogWriter(folder / "log.mcap", Origin(epoch, "memory", experiment.toml())) as writer:

        def record(packets: list[Packet]) -> None:
            nonlocal shown_s
            for packet in packets:
                writer.write(packet, peek(packet.payload))
                watch.see(packet)
            if clock.now_s() - shown_s > PROGRESS_S:
                shown_s = clock.now_s()
                display.show(watch.now())

        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            composition.fly(experiment, epoch, record)
        except KeyboardInterrupt:
            return Outcome(interrupted=True)
        except BrokenPipeError:  # of the display
            raise
        except Exception as error:  # as a process that fails: its last words, and where the others are
            (folder / "logs" / "run.txt").write_text(traceback.format_exc())
            last = f"{type(error).__name__}: {error}"
            return Outcome(failure=f"the run broke off: {last} (log: {folder / 'logs' / 'run.txt'})")
        finally:
            signal.signal(signal.SIGTERM, before)
    return Outcome()
