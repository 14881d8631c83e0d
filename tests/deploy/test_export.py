"""Does a recording that leaves the project say the same there?"""

import csv
from pathlib import Path

import numpy as np
import pytest

from deploy import commits, metrics
from deploy.__main__ import BAD_INPUT, FAILED, FINE, main
from deploy.log import LogWriter, read_log
from deploy.recording import Recording
from tests.deploy.conftest import Flown


def exported(flown: Flown, form: str, to: Path) -> Path:
    assert main(["export", str(flown.folder), "--format", form, "--out", str(to)]) == FINE
    return to


def table(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_tables_hold_truth_odometry_estimates_and_detections(
    flown: Flown, recording: Recording, tmp_path: Path
) -> None:
    folder = exported(flown, "csv", tmp_path / "tables")
    K = recording.ticks
    truth = table(folder / "truth.csv")
    assert len(truth) == 3 * K == len(table(folder / "odometry.csv"))
    last = truth[-1]
    assert last["mav"] == "3"
    assert float(last["x_m"]) == pytest.approx(recording.truth[-1, 2, 0], rel=1e-8)
    assert float(last["time_s"]) == pytest.approx(recording.time_s[-1])

    estimates = table(folder / "estimates.csv")
    assert len(estimates) == 6 * K
    row = estimates[-1]
    assert (row["agent"], row["mav"], row["state"]) == ("3", "2", "localised")
    believed = recording.beliefs.estimates
    relative = metrics.relative_from_absolute(believed)[-1, 2, 1, :3]
    true = metrics.relative_from_absolute(np.broadcast_to(recording.true_poses[:, None], believed.shape))[-1, 2, 1, :3]
    assert float(row["relative_error_m"]) == pytest.approx(np.linalg.norm(relative - true), rel=1e-6)
    assert float(row["sigma_yaw_rad"]) == pytest.approx(np.sqrt(recording.covariances[-1, 2, 1, 3, 3]), rel=1e-6)
    first = estimates[0]
    assert (first["state"], first["x_m"], first["relative_error_m"]) == ("searching", "", "")

    detections = table(folder / "detections.csv")
    assert len(detections) == sum(len(seen) for (k, _), seen in recording.detections.items() if k < K)
    assert {row["true_mav"] for row in detections} == {"0", "1", "2", "3"}


def test_trajectories_come_with_the_truth_in_the_same_frame(flown: Flown, recording: Recording, tmp_path: Path) -> None:
    folder = exported(flown, "tum", tmp_path / "tum")
    estimate = np.loadtxt(folder / "estimate" / "agent_1" / "mav_2.tum")
    reference = np.loadtxt(folder / "reference" / "agent_1" / "mav_2.tum")
    assert len(reference) == recording.ticks
    same = np.isin(reference[:, 0], estimate[:, 0])
    error = np.linalg.norm(reference[same, 1:4] - estimate[:, 1:4], axis=1)
    assert metrics.rms(error) == pytest.approx(absolute_error_m(recording, 0, 1), abs=1e-6)


def test_evo_finds_the_same_absolute_trajectory_error(flown: Flown, recording: Recording, tmp_path: Path) -> None:
    pytest.importorskip("evo", reason="the extra peer is not installed")
    from evo.core import metrics as evo_metrics
    from evo.core import sync
    from evo.tools import file_interface

    folder = exported(flown, "tum", tmp_path / "tum")
    for agent in range(3):
        for mav in range(3):
            names = [folder / kind / f"agent_{agent + 1}" / f"mav_{mav + 1}.tum" for kind in ("reference", "estimate")]
            ways = [file_interface.read_tum_trajectory_file(str(name)) for name in names]
            ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
            ape.process_data(sync.associate_trajectories(*ways))
            found = ape.get_statistic(evo_metrics.StatisticsType.rmse)
            assert found == pytest.approx(absolute_error_m(recording, agent, mav), abs=1e-6)


def absolute_error_m(recording: Recording, i: int, j: int) -> float:
    """Our root mean square over the ticks from which on i calls j localised."""
    origins = metrics.odometry_origins(recording.true_poses, recording.odometry)
    true = metrics.absolute_from_world(origins, recording.true_poses)[:, i, j, :3]
    since_s = commits.localised_since(recording.beliefs.states, recording.time_s)[i, j]
    error = np.linalg.norm(recording.beliefs.absolute[:, i, j, :3] - true, axis=1)
    return metrics.rms(error[recording.time_s >= since_s])


def test_foxglove_finds_its_own_schemas(flown: Flown, tmp_path: Path) -> None:
    pytest.importorskip("foxglove", reason="the extra viz is not installed")
    from mcap.reader import make_reader

    file = exported(flown, "mcap-foxglove", tmp_path / "run.mcap")
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        topics = {
            channel.topic: summary.schemas[channel.schema_id].name if channel.schema_id else ""
            for channel in summary.channels.values()
        }
        assert topics["/truth"] == topics["/agents/3"] == "foxglove.SceneUpdate"
        assert "/state" in topics
        counts = summary.statistics.channel_message_counts if summary.statistics else {}
        assert min(counts.values()) >= 36


def test_by_default_it_is_put_beside_the_log(flown: Flown, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(flown.folder), "--format", "csv"]) == FINE
    assert capsys.readouterr().out.strip() == str(flown.folder / "csv")
    assert main(["export", str(flown.folder), "--format", "csv"]) == BAD_INPUT  # nothing is overwritten
    assert "expected what does not exist yet" in capsys.readouterr().err


def test_what_cannot_be_exported_is_said(flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(tmp_path), "--format", "csv"]) == BAD_INPUT
    assert "log.mcap" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert (
        main(["export", str(flown.folder), "--format", "csv", "--out", str(tmp_path / "file" / "below")]) == BAD_INPUT
    )
    assert "cannot be written" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["export", str(flown.folder), "--format", "bag"])
    empty = tmp_path / "empty"
    empty.mkdir()
    with LogWriter(empty / "log.mcap", read_log(flown.folder / "log.mcap").origin):
        pass
    assert main(["export", str(empty), "--format", "csv"]) == FAILED
