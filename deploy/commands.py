"""What does each command of `swarm` do? Its words, as `__main__` has read them, to an exit status.

What is slow to import is imported where it is needed, so that a mistake in the words is answered at once.
"""

import argparse
import contextlib
import os
import re
import sys
from pathlib import Path

FINE, FAILED, BAD_INPUT, INTERRUPTED, UNHEARD = 0, 1, 2, 130, 141


def run(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy import results, terminal
    from deploy.composition import check
    from deploy.experiment import load
    from deploy.run import run
    from deploy.run_folder import folder_for
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
        return complain(outcome.failure, FAILED)
    if outcome.interrupted:
        what = "what was recorded" if summary is not None else "nothing was recorded; what there is"
        return complain(f"interrupted; {what} is in {folder}", INTERRUPTED)
    return FINE if summary is not None else complain(f"{folder}: the run ended, but nothing was recorded", FAILED)


def study(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy import study, terminal
    from deploy.experiment import load
    from deploy.run_folder import CLAIM, folder_for

    bounds = re.fullmatch(r"([0-9]{1,9}):([0-9]{1,9})", chosen.seeds)
    seeds = range(int(bounds[1]), int(bounds[2])) if bounds else range(0)
    if not seeds:
        raise BadExperiment(f"--seeds {chosen.seeds}: expected A:B with B greater than A, as in 0:20")
    if chosen.jobs is not None and chosen.jobs < 1:
        raise BadExperiment(f"--jobs {chosen.jobs}: expected 1 or more")
    wanted = study.jobs(chosen.experiment, chosen.set, seeds, chosen.grid)
    experiment = load(chosen.experiment, chosen.set)
    name = experiment.name
    folder = folder_for(f"study-{name}", chosen.out)
    (folder / CLAIM).write_text(experiment.toml())
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
        complain(failure, FAILED)
    if not done.summaries:
        (folder / CLAIM).unlink()
        if chosen.out is None:
            folder.rmdir()
    if done.interrupted:
        return complain(f"interrupted after {len(done.summaries)} of {len(wanted)} runs", INTERRUPTED)
    return FAILED if done.failures else FINE


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def score(chosen: argparse.Namespace) -> int:
    from deploy import results
    from deploy.run import score

    results.print_results(score(chosen.folder), chosen.folder)
    return FINE


def report(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy.page import build
    from deploy.run_folder import new_folder

    if chosen.paper:
        return _paper(chosen)
    if not chosen.folders:
        raise BadExperiment("which runs? expected DIR..., or --paper")
    for n, folder in enumerate(chosen.folders):
        if folder.resolve() in map(Path.resolve, chosen.folders[:n]):
            raise BadExperiment(f"{folder}: this folder is given more than once")
    page = build.build(chosen.folders, _say)
    if chosen.out is not None:
        file = chosen.out
    else:
        file = (chosen.folders[0] if len(chosen.folders) == 1 else new_folder("report")) / build.PAGE
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


def view(chosen: argparse.Namespace) -> int:
    from deploy.view.look import look

    look(chosen.folder, chosen.web, _say)
    return FINE


def export(chosen: argparse.Namespace) -> int:
    from deploy.export import export

    print(export(chosen.folder, chosen.format, chosen.out))
    return FINE


def one_process(chosen: argparse.Namespace) -> int:
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


def record(chosen: argparse.Namespace) -> int:
    from agent.interface.tables import BadExperiment
    from deploy import by_hand, results, terminal
    from deploy.experiment import load
    from deploy.run import score
    from deploy.run_folder import folder_for

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


def complain(what: object, status: int) -> int:
    print(f"swarm: {what}", file=sys.stderr)
    return status
