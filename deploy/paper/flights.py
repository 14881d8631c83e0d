"""How are the paper's experiments flown? Each run is kept as it ends: what was interrupted goes on from there."""

import hashlib
import json
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from os import getpid
from pathlib import Path
from typing import Any

import numpy as np

from agent.interface.frames import Array, range_and_bearing, relative_pose
from deploy import metrics, study, summary
from deploy.study import Job
from deploy.summary import Analysis

SEEN = 3000  # detections that are kept of a run, for the scatter


def fly(
    names: list[str], seeds: range, folder: Path, processes: int, progress: Callable[[int], None]
) -> dict[str, list[dict[str, Any]]]:
    """The runs of these experiments, by name, seed by seed; what is in the folder is not flown again.

    Args:
        folder: a file for each run, EXPERIMENT-SEED.json; one that another version of the programs flew is flown anew.
        progress: is told how many of those that were missing there are by now.
    """
    folder.mkdir(parents=True, exist_ok=True)
    version, files = programs(), {(name, seed): folder / f"{name}-{seed}.json" for name in names for seed in seeds}
    missing = [each for each, file in files.items() if not _is_of(file, version)]
    if missing:
        pool = ProcessPoolExecutor(processes, get_context("spawn"), study.worker, (getpid(),))
        try:
            running = [pool.submit(_flown, name, seed, version, files[name, seed]) for name, seed in missing]
            for done, future in enumerate(as_completed(running), 1):
                future.result()
                progress(done)
        finally:
            study.end(pool)
    return {name: [json.loads(files[name, seed].read_text()) for seed in seeds] for name in names}


def missing(names: list[str], seeds: range, folder: Path) -> int:
    """How many of these runs would have to be flown."""
    version = programs()
    return sum(not _is_of(folder / f"{name}-{seed}.json", version) for name in names for seed in seeds)


def programs() -> str:
    """A digest of all that a run's numbers depend on here: the agent, the world, the experiments and the scores."""
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    for package in ("agent", "world", "deploy"):
        for file in sorted(path for path in (root / package).rglob("*") if path.is_file()):
            drawing = {"page", "view", "paper"} & set(file.parts) and file.name != Path(__file__).name
            if file.suffix in (".py", ".toml", ".xml") and not drawing:
                digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def _is_of(file: Path, version: str) -> bool:
    try:
        return bool(json.loads(file.read_text())["version"] == version)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _flown(name: str, seed: int, version: str, file: Path) -> None:
    analysis, circumstances = study.analysed(Job(name, (), {}, seed))
    content = {
        "version": version,
        "summary": summary.summarise(analysis, circumstances),
        "time_s": _list(analysis.recording.time_s),
        "curves": curves(analysis),
        "seen": seen(analysis) if seed == 0 else None,
    }
    part = file.with_suffix(".part")
    part.write_text(json.dumps(content))
    part.replace(file)  # whole, or not at all


def curves(analysis: Analysis) -> dict[str, list[float | None]]:
    """(K,) each: root mean square errors over all pairs, m, as `WHOSE.relative`; and how the formation converges."""
    found: dict[str, list[float | None]] = {}
    for whose in ("ours", "clairvoyant", "naive"):
        course = getattr(analysis, whose)
        for kind in ("relative", "absolute"):
            position = np.where(course.known, getattr(course, kind).position_m, np.nan)
            found[f"{whose}.{kind}"] = _list(metrics.rms_over_pairs(position))
    if analysis.shapes is not None:
        found["formation_m"] = [None if shape is None else _short(shape.rms_m) for shape in analysis.shapes]
        found["to_final"] = _list(to_final(analysis))
    return found


def to_final(analysis: Analysis) -> Array:
    """(K,) m^2, the paper's E_r(t, T): squared distance of what robot 1 estimates now to what is true at the end."""
    recording = analysis.recording
    believed = relative_pose(recording.beliefs.estimates[:, 0, :1], recording.beliefs.estimates[:, 0])
    final = relative_pose(recording.true_poses[-1, :1], recording.true_poses[-1])
    squares = ((believed - final)[:, 1:, :3] ** 2).sum(axis=(1, 2))
    return np.where(analysis.ours.known[:, 0, 1:].all(axis=1), squares, np.nan)


def seen(analysis: Analysis) -> dict[str, list[float | None]]:
    """True and measured distance, m, and bearing (azimuth), rad, of some true detections."""
    recording, rows = analysis.recording, []
    for (k, mav), spherical in recording.detections.items():
        labels = recording.labels.get((k, mav))
        if labels is None or k >= recording.ticks:
            continue
        # Bearings are measured in the body frame, levelled by what the VIO says is up.
        true = range_and_bearing(relative_pose(recording.true_poses[k, mav - 1], recording.true_poses[k])[:, :3])
        rows += [
            (*true[label - 1, :2], *measured[:2]) for label, measured in zip(labels, spherical, strict=True) if label
        ]
    some = np.array(rows)[np.random.default_rng(0).permutation(len(rows))[:SEEN]].T
    return dict(zip(("distance_m", "bearing_rad", "measured_m", "measured_rad"), map(_list, some), strict=True))


def _list(values: Array) -> list[float | None]:
    return [_short(value) for value in values.tolist()]


def _short(value: float) -> float | None:
    return float(f"{value:.5g}") if np.isfinite(value) else None
