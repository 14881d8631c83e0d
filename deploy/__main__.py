"""`swarm`: which experiment shall be flown, studied or scored again?"""

import os

# Before numpy is imported, here and in every child: several threads for 50 x 50 algebra only fight for the cores, and
# how many there are would change the last bits of the results. This launcher is the place that sets up environments.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import contextlib
import re
import signal
import sys
from pathlib import Path

from deploy.bundled import bundled

FINE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(words: list[str] | None = None) -> int:
    """Exit status: 0 it did what was asked, 1 it failed, 2 bad input, 130 Ctrl-C."""
    chosen = _parser().parse_args(words)
    if chosen.command == "list":
        for name, description in bundled().items():
            print(f"{name:21} {description}")
        return FINE
    for number in (signal.SIGTERM, signal.SIGHUP):  # they end a run as Ctrl-C does
        signal.signal(number, signal.default_int_handler)
    try:
        return _do(chosen)
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)


def _do(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy.log import BadLog
    from deploy.run import NothingRecorded
    from deploy.view.window import NoWindow

    try:
        return int(chosen.do(chosen))
    except (BadExperiment, BadLog) as error:
        return _complain(error, BAD_INPUT)
    except (NothingRecorded, NoWindow) as error:
        return _complain(error, FAILED)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="swarm", description="A swarm of MAVs that localises itself.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="fly an experiment, record and score it")
    _what(run)
    run.add_argument("--seed", type=int, metavar="N", help="of every random number of the run")
    run.add_argument("--realtime", action="store_true", help="paced by the wall clock and waiting for nobody")
    run.add_argument("--in-process", action="store_true", help="everything in one process, without a network")
    run.add_argument("--view", action="store_true", help="see it in three dimensions while it is flown")
    run.add_argument("--web", action="store_true", help="the same, in a browser on this host")
    run.add_argument("--quiet", action="store_true", help="print nothing but the run folder")
    run.set_defaults(do=_run)

    study = commands.add_parser("study", help="many runs, in process: one table and plot")
    _what(study)
    study.add_argument("--seeds", required=True, metavar="A:B", help="A, A+1, ... B-1")
    study.add_argument(
        "--grid", action="append", default=[], metavar="PATH=V1,V2", help="a dimension of the grid (repeatable)"
    )
    study.add_argument("--jobs", type=int, metavar="J", help="side by side (default: one per core)")
    study.set_defaults(do=_study)

    score = commands.add_parser("score", help="metrics of a recorded run again, from the recording alone")
    score.add_argument("folder", type=Path, metavar="DIR", help="a run folder")
    score.set_defaults(do=_score)

    report = commands.add_parser("report", help="a page about runs and studies, side by side")
    report.add_argument("folders", type=Path, nargs="*", metavar="DIR", help="run and study folders")
    report.add_argument("--paper", action="store_true", help="instead: the paper's experiments, flown (runs/paper)")
    report.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="the page (default: report.html in DIR, of several in runs/report-TIME); with --paper, its folder",
    )
    report.set_defaults(do=_report)

    view = commands.add_parser("view", help="a recorded run in three dimensions")
    view.add_argument("folder", type=Path, metavar="DIR", help="a run folder")
    view.add_argument("--web", action="store_true", help="in a browser on this host, instead of a window")
    view.set_defaults(do=_view)

    export = commands.add_parser("export", help="a recorded run for other programs")
    export.add_argument("folder", type=Path, metavar="DIR", help="a run folder")
    export.add_argument("--format", required=True, choices=("tum", "csv", "rrd", "mcap-foxglove"))
    export.add_argument("--out", type=Path, metavar="PATH", help="the file or folder (default: in DIR)")
    export.set_defaults(do=_export)

    commands.add_parser("list", help="the bundled experiments")

    helps = {"agent": "one MAV", "world": "the world", "recorder": "the recorder, until Ctrl-C; then scores"}
    for name, words in helps.items():
        alone = commands.add_parser(name, help=f"{words}: one process by hand, for several hosts")
        _what(alone, out=name == "recorder")
        if name == "agent":
            alone.add_argument("--mav", type=int, required=True, metavar="I", help="which MAV, 1..N")
        alone.add_argument("--network", type=Path, required=True, metavar="FILE", help="endpoints of all (TOML)")
        alone.add_argument("--epoch", type=int, required=True, metavar="E", help="number of the run, on all hosts")
        alone.set_defaults(do=_record if name == "recorder" else _one_process)
    return parser


def _what(parser: argparse.ArgumentParser, out: bool = True) -> None:
    parser.add_argument("experiment", metavar="EXPERIMENT", help="a bundled name (swarm list) or a TOML file")
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=VALUE", help="override a key, as in agent.detector.P_D=0.8"
    )
    if out:
        parser.add_argument(
            "--out", type=Path, metavar="DIR", help="where the results go (default: runs/EXPERIMENT-TIME)"
        )


def _run(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy import results, terminal
    from deploy.composition import check
    from deploy.experiment import load
    from deploy.run import folder_for, run
    from deploy.supervisor import Outcome
    from deploy.view import look, window

    view = chosen.view or chosen.web
    if view and chosen.in_process:
        raise BadExperiment("--view --in-process: expected one of them; `swarm view DIR` shows the run afterwards")
    experiment = load(chosen.experiment, chosen.set, chosen.seed, chosen.realtime)
    check(experiment, chosen.in_process)
    if view:
        window.program()
    folder = folder_for(experiment.name, chosen.out)
    title = f"{experiment.name}, seed {experiment.fleet.seed}"
    with contextlib.ExitStack() as stack:
        display = terminal.display(title, chosen.quiet)
        seen = stack.enter_context(window.Window(chosen.web, folder / window.LOG)) if view else None
        if seen is not None and seen.page and not chosen.quiet:
            print(f"to be seen at {seen.page}", flush=True)
        outcome, summary = run(experiment, folder, chosen.in_process, display, view=seen.url if seen else None)
        if chosen.quiet:
            print(folder, flush=True)
        elif summary is not None:
            results.print_results(summary, folder)
        if seen is not None and outcome == Outcome():
            look.stay(seen, _say)
    if outcome.failure is not None:
        return _complain(outcome.failure, FAILED)
    if outcome.interrupted:
        what = "what was recorded" if summary is not None else "nothing was recorded; what there is"
        return _complain(f"interrupted; {what} is in {folder}", INTERRUPTED)
    return FINE if summary is not None else _complain(f"{folder}: the run ended, but nothing was recorded", FAILED)


def _study(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy import study, terminal
    from deploy.experiment import load
    from deploy.run import folder_for

    bounds = re.fullmatch(r"([0-9]{1,9}):([0-9]{1,9})", chosen.seeds)
    seeds = range(int(bounds[1]), int(bounds[2])) if bounds else range(0)
    if not seeds:
        raise BadExperiment(f"--seeds {chosen.seeds}: expected A:B with B greater than A, as in 0:20")
    if chosen.jobs is not None and chosen.jobs < 1:
        raise BadExperiment(f"--jobs {chosen.jobs}: expected 1 or more")
    wanted = study.jobs(chosen.experiment, chosen.set, seeds, chosen.grid)
    name = load(chosen.experiment, chosen.set).name
    folder = folder_for(f"study-{name}", chosen.out)
    done = study.run_all(wanted, min(chosen.jobs or _cores(), len(wanted)), terminal.counter(len(wanted)))
    if done.summaries:
        from deploy import heat_map, report, results, summary  # matplotlib: not for a mistake in the words

        content = study.evaluate(done.summaries, name, f"seeds {seeds[0]} to {seeds[-1]}")
        numbers = heat_map.grid_of(content["cells"])
        if numbers is None:
            report.draw_study(content, folder / "study.png")
        else:
            heat_map.draw(content, numbers, folder / "study.png")
        for cell in content["cells"]:
            del cell["values"]  # they are in the runs
        (folder / "study.json").write_text(summary.to_json(content))
        results.print_study(content, folder)
    for failure in done.failures:
        _complain(failure, FAILED)
    if not done.summaries:
        folder.rmdir()
    if done.interrupted:
        return _complain(f"interrupted after {len(done.summaries)} of {len(wanted)} runs", INTERRUPTED)
    return FAILED if done.failures else FINE


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _score(chosen: argparse.Namespace) -> int:
    from deploy import results
    from deploy.run import score

    results.print_results(score(chosen.folder), chosen.folder)
    return FINE


def _report(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy.page import build
    from deploy.run import folder_for

    if chosen.paper:
        return _paper(chosen)
    if not chosen.folders:
        raise BadExperiment("which runs? expected DIR..., or --paper")
    if len(set(map(Path.resolve, chosen.folders))) < len(chosen.folders):
        raise BadExperiment("a folder is given more than once")
    page = build.build(chosen.folders, _say)
    if chosen.out is not None:
        file = chosen.out
    else:
        file = (chosen.folders[0] if len(chosen.folders) == 1 else folder_for("report", None)) / build.PAGE
    try:
        file.write_text(page)
    except OSError as error:
        raise BadExperiment(f"{file}: cannot be written: {error.strerror}") from None
    print(file)
    return FINE


def _paper(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy import terminal
    from deploy.paper import build

    if chosen.folders:
        raise BadExperiment("--paper: expected no DIR, it flies its own runs")
    folder = chosen.out or Path("runs", "paper")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadExperiment(f"--out {folder}: cannot be made: {error.strerror}") from None
    print(build.build(folder, _cores(), _say, terminal.counter))
    return FINE


def _view(chosen: argparse.Namespace) -> int:
    from deploy.view.look import look

    look(chosen.folder, chosen.web, _say)
    return FINE


def _export(chosen: argparse.Namespace) -> int:
    from deploy.export import export

    print(export(chosen.folder, chosen.format, chosen.out))
    return FINE


def _one_process(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy import by_hand
    from deploy.composition import check
    from deploy.experiment import load

    experiment = load(chosen.experiment, chosen.set)
    check(experiment, in_process=False)
    name = "world" if chosen.command == "world" else f"mav_{chosen.mav}"
    if chosen.command == "agent" and chosen.mav not in experiment.fleet.ids:
        raise BadExperiment(f"--mav {chosen.mav}: expected 1 to {experiment.fleet.mavs}")
    return by_hand.run(experiment, by_hand.places(chosen.network, experiment), name, chosen.epoch)


def _record(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy import by_hand, results, terminal
    from deploy.experiment import load
    from deploy.run import folder_for, score

    experiment = load(chosen.experiment, chosen.set)
    where = by_hand.places(chosen.network, experiment)
    if "recorder" not in where:
        raise BadExperiment(f"--network {chosen.network}: recorder is missing, expected an endpoint")
    folder = folder_for(experiment.name, chosen.out)
    status = by_hand.record(experiment, where, chosen.epoch, folder, terminal.display(experiment.name, False))
    if status:
        return FAILED
    results.print_results(score(folder), folder)
    return FINE


def _say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


def _complain(what: object, status: int) -> int:
    print(f"swarm: {what}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
