"""`swarm`: which experiment shall be flown, studied or scored again?"""

import os

# Before numpy is imported, here and in every child: several threads for 50 x 50 algebra only fight for the cores, and
# how many there are would change the last bits of the results. This launcher is the place that sets up environments.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import re
import signal
import sys
from pathlib import Path

from deploy import commands
from deploy.bundled import bundled
from deploy.commands import BAD_INPUT, FAILED, FINE, INTERRUPTED, UNHEARD


def main(words: list[str] | None = None) -> int:
    """Exit status: 0 it did what was asked, 1 it failed, 2 bad input, 130 Ctrl-C, 141 nobody reads what it says."""
    # Closed, as in `swarm run line >&-`, and whatever is opened next would take its number and be written into.
    sys.stdout = sys.stdout or os.fdopen(_nowhere(), "w")
    sys.stderr = sys.stderr or os.fdopen(_nowhere(), "w")
    try:
        status = _listened_to(words)
        sys.stdout.flush()
        return status
    except KeyboardInterrupt as interrupt:
        return commands.complain("; ".join(("interrupted", *interrupt.args)), INTERRUPTED)
    except OSError as error:
        os.dup2(_nowhere(), sys.stdout.fileno())  # what is still in its buffer cannot be said
        if isinstance(error, BrokenPipeError):  # as in `swarm run line | head -3`
            return UNHEARD
        return commands.complain(error, FAILED)  # a disk is full, say


def _nowhere() -> int:
    return os.open(os.devnull, os.O_WRONLY)


def _listened_to(words: list[str] | None) -> int:
    chosen = _parser().parse_args(words)
    if chosen.command == "list":
        for name, description in bundled().items():
            print(f"{name:21} {description}")
        return FINE
    for number in (signal.SIGTERM, signal.SIGHUP):  # they end a run as Ctrl-C does
        signal.signal(number, signal.default_int_handler)
    return _do(chosen)


def _do(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy.log import BadLog
    from deploy.run import NothingRecorded, NotScored
    from deploy.view.window import NoWindow

    try:
        return int(chosen.do(chosen))
    except (BadExperiment, BadLog) as error:
        return commands.complain(error, BAD_INPUT)
    except (NothingRecorded, NotScored, NoWindow) as error:
        return commands.complain(error, FAILED)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="swarm", description="A swarm of MAVs that localises itself.")
    each = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = each.add_parser("run", help="fly an experiment, record and score it")
    _what(run)
    run.add_argument("--seed", type=int, metavar="N", help="of every random number of the run")
    run.add_argument("--realtime", action="store_true", help="paced by the wall clock and waiting for nobody")
    run.add_argument("--in-process", action="store_true", help="everything in one process, without a network")
    run.add_argument("--view", action="store_true", help="see it in three dimensions while it is flown")
    run.add_argument("--web", action="store_true", help="the same, in a browser on this host")
    run.add_argument("--quiet", action="store_true", help="print nothing but the run folder")
    run.set_defaults(do=commands.run)

    study = each.add_parser("study", help="many runs, in process: one table and plot")
    _what(study)
    study.add_argument("--seeds", required=True, metavar="A:B", help="A, A+1, ... B-1")
    study.add_argument(
        "--grid", action="append", default=[], metavar="PATH=V1,V2", help="a dimension of the grid (repeatable)"
    )
    study.add_argument("--jobs", type=int, metavar="J", help="side by side (default: one per core)")
    study.set_defaults(do=commands.study)

    score = each.add_parser("score", help="metrics of a recorded run again, from the recording alone")
    score.add_argument("folder", type=_path, metavar="DIR", help="a run folder")
    score.set_defaults(do=commands.score)

    report = each.add_parser("report", help="a page about runs and studies, side by side")
    report.add_argument("folders", type=_path, nargs="*", metavar="DIR", help="run and study folders")
    report.add_argument("--paper", action="store_true", help="instead: the paper's experiments, flown (runs/paper)")
    report.add_argument(
        "--out",
        type=_path,
        metavar="FILE",
        help="the page (default: report.html in DIR, of several in runs/report-TIME); with --paper, its folder",
    )
    report.set_defaults(do=commands.report)

    view = each.add_parser("view", help="a recorded run in three dimensions")
    view.add_argument("folder", type=_path, metavar="DIR", help="a run folder")
    view.add_argument("--web", action="store_true", help="in a browser on this host, instead of a window")
    view.set_defaults(do=commands.view)

    export = each.add_parser("export", help="a recorded run for other programs")
    export.add_argument("folder", type=_path, metavar="DIR", help="a run folder")
    export.add_argument("--format", required=True, choices=("tum", "csv", "rrd", "mcap-foxglove"))
    export.add_argument("--out", type=_path, metavar="PATH", help="the file or folder (default: in DIR)")
    export.set_defaults(do=commands.export)

    each.add_parser("list", help="the bundled experiments")

    helps = {"agent": "one MAV", "world": "the world", "recorder": "the recorder, until Ctrl-C; then scores"}
    for name, words in helps.items():
        alone = each.add_parser(name, help=f"{words}: one process by hand, for several hosts")
        _what(alone, out=name == "recorder")
        if name == "agent":
            alone.add_argument("--mav", type=int, required=True, metavar="I", help="which MAV, 1..N")
        alone.add_argument("--network", type=_path, required=True, metavar="FILE", help="endpoints of all (TOML)")
        alone.add_argument("--epoch", type=_epoch, required=True, metavar="E", help="number of the run, on all hosts")
        alone.set_defaults(do=commands.record if name == "recorder" else commands.one_process)
    return parser


def _path(text: str) -> Path:
    """What is empty would be the working directory."""
    if not text:
        raise argparse.ArgumentTypeError("expected a path, not nothing")
    return Path(text)


def _epoch(text: str) -> int:
    """What fits into a message."""
    if not re.fullmatch("[0-9]{1,18}", text):
        raise argparse.ArgumentTypeError(f"{text:.30}: expected a number of at most 18 digits")
    return int(text)


def _what(parser: argparse.ArgumentParser, out: bool = True) -> None:
    parser.add_argument("experiment", metavar="EXPERIMENT", help="a bundled name (swarm list) or a TOML file")
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=VALUE", help="override a key, as in agent.detector.P_D=0.8"
    )
    if out:
        parser.add_argument(
            "--out", type=_path, metavar="DIR", help="where the results go (default: runs/EXPERIMENT-TIME)"
        )


if __name__ == "__main__":
    sys.exit(main())
