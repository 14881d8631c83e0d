"""What holds over many runs? Seeds times cells of a grid, each run in memory, with means and 95 % intervals."""

import contextlib
import itertools
import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Generator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from typing import TYPE_CHECKING, Any, NamedTuple

from agent.interface.bus import Packet
from agent.interface.tables import BadExperiment
from deploy.experiment import load, value
from deploy.leash import die_with

if TYPE_CHECKING:  # numpy and matplotlib are slow to import: `swarm` starts without them
    from deploy.summary import Analysis, Circumstances

METRICS: dict[str, Callable[[dict[str, Any]], float | None]] = {
    "relative_rmse_m": lambda run: run["relative"]["rmse_m"],
    "relative_rmse_deg": lambda run: run["relative"]["rmse_deg"],
    "absolute_rmse_m": lambda run: run["absolute"]["rmse_m"],
    "absolute_rmse_deg": lambda run: run["absolute"]["rmse_deg"],
    "naive_relative_rmse_m": lambda run: run["naive"]["relative"]["rmse_m"],
    "clairvoyant_relative_rmse_m": lambda run: run["clairvoyant"]["relative"]["rmse_m"],
    "ratio_to_naive": lambda run: _ratio(run["relative"]["rmse_m"], run["naive"]["relative"]["rmse_m"]),
    "ratio_to_clairvoyant": lambda run: _ratio(run["relative"]["rmse_m"], run["clairvoyant"]["relative"]["rmse_m"]),
    "anees": lambda run: run["anees"],
    "nis_inside": lambda run: run["nis_inside"],
    "disagreement_m": lambda run: run["disagreement_m"],
    "localised_at_s": lambda run: _latest(run["mavs"]),
    "wrong_commits": lambda run: float(sum(mav["wrong_commits"] for mav in run["mavs"])),
    "commit_nees": lambda run: run["registration"]["commit_nees"],
    "position_1s_m": lambda run: run["registration"]["position_1s_m"],
    "yaw_1s_rad": lambda run: run["registration"]["yaw_1s_rad"],
    "position_1s_p95_m": lambda run: run["registration"]["position_1s_p95_m"],
    "formation_rms_m": lambda run: run["flight"]["formation_rms_m"],
    "nearest_m": lambda run: run["flight"]["nearest_m"],
    "yaw_1s_p95_rad": lambda run: run["registration"]["yaw_1s_p95_rad"],
}

MOST_RUNS = 100_000


class Job(NamedTuple):
    """One run: everything a worker needs."""

    source: str
    changes: tuple[str, ...]
    grid: dict[str, Any]  # what distinguishes its cell
    seed: int

    def words(self) -> str:
        cell = "".join(f", {path}={setting}" for path, setting in self.grid.items())
        return f"seed {self.seed}{cell}"


class Study(NamedTuple):
    summaries: list[dict[str, Any]]  # of the runs that succeeded, in the order of the jobs
    failures: list[str]  # which run failed, and why
    interrupted: bool


def jobs(source: str, changes: list[str], seeds: range, grid: list[str]) -> list[Job]:
    """All runs, cell by cell, checked: a mistake shows before anything is started.

    Args:
        source: bundled experiment or path.
        changes: "PATH=VALUE", for all runs.
        seeds: one run each per cell.
        grid: "PATH=V1,V2", one dimension each.

    Raises:
        BadExperiment: some run could not be made.
    """
    from deploy.composition import check

    named = list(map(_dimension, grid))
    dimensions = [[(path, text.strip()) for text in texts.split(",")] for path, texts in named]
    for path, _ in named:
        if sum(path == other for other, _ in named) > 1:
            raise BadExperiment(f"--grid {path}: given more than once")
    for dimension in dimensions:
        if len(set(dimension)) < len(dimension):
            raise BadExperiment(f"--grid {dimension[0][0]}: a value is given more than once")
    runs = math.prod(map(len, dimensions)) * len(seeds)
    if runs > MOST_RUNS:
        raise BadExperiment(f"{runs} runs: expected at most {MOST_RUNS}")
    made = []
    for cell in itertools.product(*dimensions):
        cell_changes = (*changes, *(f"{path}={text}" for path, text in cell))
        settings = {path: value(text.strip(), f"{path}={text}") for path, text in cell}
        experiment = load(source, cell_changes, seeds[0])
        check(experiment, in_process=True)
        made += [Job(source, cell_changes, settings, seed) for seed in seeds]
    return made


def _dimension(text: str) -> tuple[str, str]:
    path, equals, texts = text.partition("=")
    if not equals or not texts.strip():
        raise BadExperiment(f"--grid {text}: expected TABLE.KEY=VALUE,VALUE")
    if path.strip() == "fleet.seed":
        raise BadExperiment("--grid fleet.seed: the seeds are what --seeds says")
    return path.strip(), texts


def analysed(job: Job) -> "tuple[Analysis, Circumstances]":
    """One run, flown in memory, replayed by the clairvoyant twin, and looked at."""
    from agent.interface import clock
    from deploy import formation, summary
    from deploy.clairvoyant import replay
    from deploy.composition import fly
    from deploy.recording import assemble
    from deploy.run import EPOCHS

    experiment = load(job.source, job.changes, job.seed)
    packets: list[Packet] = []
    began_s = clock.now_s()
    fly(experiment, EPOCHS[0], packets.extend)
    wall_s = clock.now_s() - began_s
    recording = assemble(packets, experiment.fleet, EPOCHS[0])
    twin = replay(recording, experiment.agent)
    analysis = summary.analyse(recording, twin, experiment.faults, formation.mission_of(experiment.agent))
    return analysis, summary.Circumstances(experiment.name, "memory", wall_s)


def run_one(job: Job) -> dict[str, Any]:
    """The summary of one run; with the cell it belongs to."""
    from deploy import summary

    return summary.summarise(*analysed(job)) | {"grid": job.grid}


def run_all(wanted: list[Job], processes: int, progress: Callable[[int], None]) -> Study:
    """Runs them side by side; Ctrl-C ends them all, and what is finished by then counts."""
    done: dict[int, dict[str, Any]] = {}
    failures: list[str] = []
    interrupted = False
    with contextlib.closing(_results(wanted, processes)) as results:
        try:
            for index, result in results:
                if isinstance(result, Exception):
                    failures.append(f"{wanted[index].words()}: {type(result).__name__}: {result}")
                else:
                    done[index] = result
                progress(len(done) + len(failures))
        except KeyboardInterrupt:
            interrupted = True
    return Study([done[index] for index in sorted(done)], failures, interrupted)


def _results(wanted: list[Job], processes: int) -> Generator[tuple[int, dict[str, Any] | Exception]]:
    """Index and result of every job, in the order in which they end."""
    if processes == 1:
        for index, job in enumerate(wanted):
            try:
                yield index, run_one(job)
            except Exception as error:  # the other runs go on; the study names this one
                yield index, error
        return
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), worker, (os.getpid(),))
    try:
        running = {pool.submit(run_one, job): index for index, job in enumerate(wanted)}
        while running:
            ended, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                failure = future.exception()
                yield running.pop(future), failure if isinstance(failure, Exception) else future.result()
    finally:
        end(pool)


def end(pool: ProcessPoolExecutor) -> None:
    """At once, whatever its workers do."""
    pool.shutdown(wait=False, cancel_futures=True)
    for child in multiprocessing.active_children():
        child.terminate()
        child.join()


def worker(launcher: int) -> None:
    """Ctrl-C is the launcher's; a worker dies with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with(launcher)


def evaluate(summaries: list[dict[str, Any]], experiment: str, seeds: str) -> dict[str, Any]:
    """The content of study.json, and for the figure every run's value."""
    from deploy.metrics import anees_band

    cells: list[dict[str, Any]] = []
    for _, group in itertools.groupby(summaries, key=lambda run: repr(run["grid"])):
        runs = list(group)
        cell: dict[str, Any] = {"grid": runs[0]["grid"], "seeds": len(runs)}
        cell["values"] = {name: [metric(run) for run in runs] for name, metric in METRICS.items()}
        cell |= {name: interval(values) for name, values in cell["values"].items()}
        cell |= _localisation(runs)
        cell["localised_at_s"]["p95"] = percentile_95(cell["values"]["localised_at_s"])
        wrong = cell["values"]["wrong_commits"]
        cell["wrong_commits"] |= {"total": int(sum(wrong)), "runs": sum(each > 0 for each in wrong)}
        cell["anees_band"] = anees_band(len(runs), runs[0]["agents"])._asdict()
        cells.append(cell)
    return {"experiment": experiment, "seeds": seeds, "runs": summaries, "cells": cells}


def _localisation(runs: list[dict[str, Any]]) -> dict[str, float | None]:
    """Shares of the runs, and the largest cost of a tick."""
    ticks = [run["estimator_ms"]["tick_p99"] for run in runs]
    return {
        "all_localised": sum(_latest(run["mavs"]) is not None for run in runs) / len(runs),
        "ambiguous_to_the_end": sum(all(mav["state"] == "ambiguous" for mav in run["mavs"]) for run in runs)
        / len(runs),
        "largest_tick_p99_ms": max((each for each in ticks if each is not None), default=None),
    }


def percentile_95(times_s: list[float | None]) -> float | None:
    """The time that 95 % of the runs did not exceed, None in it being never; and so is None as the answer."""
    ordered = sorted(math.inf if each is None else each for each in times_s)
    least = ordered[math.ceil(len(ordered) * 95 / 100) - 1]  # no mean of two, of which one may be infinite
    return least if math.isfinite(least) else None


def interval(values: list[float | None]) -> dict[str, float | None]:
    """Mean of the known values and its 95 % interval by Student's t; no interval of a single one."""
    known = [each for each in values if each is not None]
    if not known:
        return {"mean": None, "low": None, "high": None}
    mean = math.fsum(known) / len(known)
    if len(known) == 1:
        return {"mean": mean, "low": None, "high": None}
    from scipy.special import stdtrit  # scipy.stats takes five seconds to import

    variance = math.fsum((each - mean) ** 2 for each in known) / (len(known) - 1)
    half = float(stdtrit(len(known) - 1, 0.975)) * math.sqrt(variance / len(known))
    return {"mean": mean, "low": mean - half, "high": mean + half}


def _ratio(ours: float | None, other: float | None) -> float | None:
    return None if ours is None or not other else ours / other


def _latest(mavs: list[dict[str, Any]]) -> float | None:
    """When the last agent had localised all others; None if one never did."""
    times = [mav["localised_at_s"] for mav in mavs]
    return None if None in times else max(times, default=None)
