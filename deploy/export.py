"""How does a recording get into other programs? `swarm export`, one format a file or folder.

tum: trajectories, with the truth in each agent's own frame, so that `evo_ape tum` compares without aligning anything.
csv: tables with a header, units in the names. rrd: for rerun. mcap-foxglove: for Foxglove, and what else knows its
schemas.
"""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from agent.interface.frames import Array
from agent.interface.messages import STATES
from agent.interface.tables import BadExperiment
from deploy import metrics, tum
from deploy.experiment import Experiment, from_text
from deploy.log import read_log
from deploy.recording import UNKNOWN, Recording, assemble
from deploy.run import NothingRecorded

FORMATS = {"tum": "tum", "csv": "csv", "rrd": "run.rrd", "mcap-foxglove": "foxglove.mcap"}  # and what is made in DIR


def export(folder: Path, form: str, out: Path | None) -> Path:
    """Writes a recorded run in another format; returns where.

    Raises:
        BadExperiment: there is something there already, or what the format needs is not installed.
        BadLog, NothingRecorded: there is no log in the folder, or it holds no tick.
    """
    to = folder / FORMATS[form] if out is None else out
    log = read_log(folder / "log.mcap")
    experiment = from_text(log.origin.experiment)
    if to.exists() and not (to.is_dir() and not any(to.iterdir())):
        raise BadExperiment(f"--out {to}: expected what does not exist yet")
    recording = assemble(log.packets, experiment.fleet, log.origin.epoch)
    if not recording.ticks:
        raise NothingRecorded(f"{folder / 'log.mcap'}: no tick of the run was recorded")
    _needs(form)
    try:
        to.parent.mkdir(parents=True, exist_ok=True)
        _WRITERS[form](to, folder, recording, experiment)
    except OSError as error:
        raise BadExperiment(f"--out {to}: cannot be written: {error.strerror}") from None
    return to


def _needs(form: str) -> None:
    import importlib.util

    module = {"rrd": "rerun", "mcap-foxglove": "foxglove"}.get(form)
    if module is not None and importlib.util.find_spec(module) is None:
        raise BadExperiment(f"--format {form} needs {module}: `make viz`, or pip install 'swarm-cpdaf[viz]'")


def _tum(to: Path, _: Path, recording: Recording, __: Experiment) -> None:
    tum.export(recording, to)
    tum.export_references(recording, to)


def _rrd(to: Path, folder: Path, recording: Recording, experiment: Experiment) -> None:
    from deploy.view import scene, viewer

    fleet = experiment.fleet
    viewer.write(to, f"{experiment.name}, seed {fleet.seed}", fleet.mavs, scene.scenes(folder))


def _foxglove(to: Path, folder: Path, _: Recording, experiment: Experiment) -> None:
    from deploy.view import foxglove_file, scene

    foxglove_file.write(to, experiment.fleet.mavs, scene.scenes(folder))


def _csv(to: Path, _: Path, recording: Recording, __: Experiment) -> None:
    to.mkdir(exist_ok=True)
    numbers = np.arange(1, recording.fleet.mavs + 1)
    K, N = recording.truth.shape[:2]
    when, who = np.repeat(recording.time_s, N), np.tile(numbers, K)
    pose = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    for name, poses in (("truth", recording.truth), ("odometry", recording.vio)):
        _table(to / f"{name}.csv", ("time_s", "mav", *pose), np.column_stack([when, who, poses.reshape(-1, 7)]), (1,))
    _estimates(to / "estimates.csv", recording)
    rows = [
        [recording.time_s[k], mav, *seen, label]
        for (k, mav), spherical in sorted(recording.detections.items())
        if k < K
        for seen, label in zip(
            spherical, recording.labels.get((k, mav), np.full(len(spherical), np.nan)).tolist(), strict=True
        )
    ]
    heading = ("time_s", "mav", "range_m", "azimuth_rad", "elevation_rad", "true_mav")  # 0: a false detection
    _table(to / "detections.csv", heading, np.array(rows).reshape(-1, 6), (1, 5))


def _estimates(path: Path, recording: Recording) -> None:
    """A line for every tick, agent and other MAV of which the agent said anything."""
    states, estimates = recording.beliefs.states, recording.beliefs.estimates
    k, i, j = np.nonzero((states != UNKNOWN) & ~np.eye(recording.fleet.mavs, dtype=bool))
    relative = metrics.relative_from_absolute(estimates)
    true = metrics.relative_from_absolute(np.broadcast_to(recording.true_poses[:, None], estimates.shape))
    error = metrics.errors(relative, true)
    deviations = np.sqrt(np.maximum(recording.covariances[k, i, j][:, range(4), range(4)], 0))
    columns = np.column_stack(
        [
            recording.time_s[k], i + 1, j + 1, states[k, i, j], estimates[k, i, j], deviations,
            error.position_m[k, i, j], error.yaw_rad[k, i, j],
        ]
    )  # fmt: skip
    columns[states[k, i, j] != STATES.index("localised"), 4:] = np.nan
    heading = (
        "time_s", "agent", "mav", "state", "x_m", "y_m", "z_m", "yaw_rad", "sigma_x_m", "sigma_y_m", "sigma_z_m",
        "sigma_yaw_rad", "relative_error_m", "relative_error_rad",
    )  # fmt: skip
    _table(path, heading, columns, (1, 2), state=3)


def _table(path: Path, heading: Iterable[str], rows: Array, whole: tuple[int, ...], state: int | None = None) -> None:
    """What is unknown is left empty."""
    with path.open("w") as file:
        file.write(",".join(heading) + "\n")
        for row in rows.tolist():
            cells = ["" if value != value else f"{value:.9g}" for value in row]
            for column in whole:
                cells[column] = "" if row[column] != row[column] else str(int(row[column]))
            if state is not None:
                cells[state] = STATES[int(row[state])]
            file.write(",".join(cells) + "\n")


_WRITERS: dict[str, Callable[[Path, Path, Recording, Experiment], None]] = {
    "tum": _tum,
    "csv": _csv,
    "rrd": _rrd,
    "mcap-foxglove": _foxglove,
}
