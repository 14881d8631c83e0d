"""What is in a run folder, and is it the same when the run is scored or flown again?"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from agent.interface import messages
from agent.interface.bus import Packet
from deploy import __main__ as main_module
from deploy import composition, report, results, study
from deploy import run as run_module
from deploy.__main__ import main
from deploy.experiment import Experiment, load
from deploy.log import LogWriter, Origin, read_log
from deploy.peek import peek
from deploy.recording import Recording, assemble
from deploy.run import run
from deploy.supervisor import Outcome
from deploy.terminal import Quiet
from tests.deploy.conftest import EXPERIMENT, SMALL, TICKS, Flown, registration

SUMMARY = {
    "experiment", "seed", "mode", "transport", "agents", "ticks", "sim_s", "wall_s", "real_time_factor", "late_ticks",
    "relative", "absolute", "naive", "clairvoyant", "anees", "nis_inside", "disagreement_m", "estimator_ms", "network",
    "registration", "across_cuts", "mavs", "late_starts", "flight",
}  # fmt: skip
SCORE = {"rmse_m", "rmse_deg", "final_rmse_m", "final_rmse_deg", "max_m"}


def test_the_folder_and_the_summary_are_as_the_contract_says(flown: Flown) -> None:
    assert flown.result.outcome == Outcome()
    names = {str(path.relative_to(flown.folder)) for path in flown.folder.rglob("*") if path.is_file()}
    mavs = (1, 2, 3)
    assert names == {"experiment.toml", "log.mcap", "summary.json", "errors.png"} | {
        *(f"{kind}/mav_{mav}.tum" for kind in ("truth", "vio") for mav in mavs),
        *(f"estimate/agent_{agent}/mav_{mav}.tum" for agent in mavs for mav in mavs),
    }
    summary = json.loads((flown.folder / "summary.json").read_text())
    assert summary == flown.result.summary
    assert summary.keys() == SUMMARY
    for scores in (summary, summary["naive"], summary["clairvoyant"]):
        assert scores["relative"].keys() == scores["absolute"].keys() == SCORE
    assert summary["network"].keys() == {
        "sent", "received", "rejected", "late", "duplicate", "dropped_by_faults", "bytes_per_agent_s",
    }  # fmt: skip
    assert summary["estimator_ms"].keys() == {"station_p50", "station_p99", "tick_p50", "tick_p99"}
    assert [mav["id"] for mav in summary["mavs"]] == [1, 2, 3]
    assert summary["registration"].keys() == {
        "commit_nees", "position_1s_m", "yaw_1s_rad", "position_1s_p95_m", "yaw_1s_p95_rad",
    }  # fmt: skip
    assert summary["flight"].keys() == {"nearest_m", "collisions", "formation_rms_m", "formations"}
    assert summary["mavs"][0].keys() == {
        "id", "state", "reason", "hypotheses", "localised_at_s", "wrong_commits", "restarts",
    }  # fmt: skip
    assert (summary["mode"], summary["transport"], summary["ticks"], summary["seed"]) == (
        "lockstep",
        "memory",
        TICKS,
        5,
    )
    assert summary["late_ticks"] == 0


def test_trajectories_are_tum(flown: Flown, recording: Recording) -> None:
    truth = np.loadtxt(flown.folder / "truth" / "mav_2.tum")
    assert truth.shape == (TICKS, 8)
    np.testing.assert_allclose(truth[:, 0], np.arange(TICKS) / 10)
    np.testing.assert_allclose(np.linalg.norm(truth[:, 4:], axis=1), 1, atol=1e-6)
    estimate = np.loadtxt(flown.folder / "estimate" / "agent_1" / "mav_2.tum")
    np.testing.assert_allclose(estimate[:, 1:4], recording.beliefs.absolute[-len(estimate) :, 0, 1, :3], atol=1e-8)
    assert (estimate[:, 4:6] == 0).all()
    begun = flown.result.summary["mavs"][0]["localised_at_s"]  # type: ignore[index]
    assert estimate[0, 0] <= begun


def test_scoring_again_gives_the_same_from_the_log_alone(
    flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "log.mcap").write_bytes((flown.folder / "log.mcap").read_bytes())
    assert main(["score", str(tmp_path)]) == 0
    assert "clairvoyant" in capsys.readouterr().out
    assert (tmp_path / "summary.json").read_text() == (flown.folder / "summary.json").read_text()
    for path in flown.folder.rglob("*.tum"):
        assert (tmp_path / path.relative_to(flown.folder)).read_bytes() == path.read_bytes()


def test_scoring_a_log_that_knows_why(flown: Flown, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The last words of the first agent are that it can tell two MAVs from each other no more."""
    log = read_log(flown.folder / "log.mcap")
    last = max(
        (packet for packet in log.packets if packet.key == "belief/1/estimate"), key=lambda p: peek(p.payload).seq
    )
    estimate = messages.decode(messages.Estimate, last.payload, log.origin.epoch)
    doubtful = Packet(last.key, messages.encode(msgspec.structs.replace(estimate, states=bytes([2, 2, 1]))))
    said = registration(1, log.origin.epoch, ["", "", "two places fit [a, b]"], 2, tick=TICKS - 1)
    with LogWriter(tmp_path / "log.mcap", log.origin) as writer:
        for packet in (*log.packets, doubtful, said):
            writer.write(packet, peek(packet.payload))
    assert main(["score", str(tmp_path)]) == 0
    assert "\nMAV 1: ambiguous at the end (two places fit [a, b])\n" in capsys.readouterr().out
    mav = json.loads((tmp_path / "summary.json").read_text())["mavs"][0]
    assert (mav["state"], mav["reason"], mav["hypotheses"]) == ("ambiguous", "two places fit [a, b]", 2)


def test_scoring_what_is_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", str(tmp_path)]) == 2
    assert "No such file" in capsys.readouterr().err


def test_half_a_log_is_scored_too(flown: Flown, tmp_path: Path) -> None:
    """Of a recorder that was killed after it had saved half of the run."""
    log = read_log(flown.folder / "log.mcap")
    with LogWriter(tmp_path / "whole.mcap", log.origin) as writer:
        for packet in log.packets[: len(log.packets) // 2]:
            writer.write(packet, peek(packet.payload))
        writer.flush()
        (tmp_path / "log.mcap").write_bytes((tmp_path / "whole.mcap").read_bytes())
    assert main(["score", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert 0 < summary["ticks"] < TICKS
    assert summary["wall_s"] is None
    assert summary["late_ticks"] is None  # the world has not come to say it


def test_a_log_without_a_tick_is_not_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with LogWriter(tmp_path / "log.mcap", Origin(1, "memory", load("line").toml())):
        pass
    assert main(["score", str(tmp_path)]) == 1
    assert "no tick of the run was recorded" in capsys.readouterr().err
    assert not (tmp_path / "summary.json").exists()


def test_the_resolved_experiment_flown_again_gives_the_same_estimates(flown: Flown, recording: Recording) -> None:
    again = load(str(flown.folder / "experiment.toml"))
    assert again == flown.experiment
    packets: list[Packet] = []
    composition.fly(again, 1, packets.extend)
    second = assemble(packets, again.fleet, 1)
    assert recording.beliefs.estimates.tobytes() == second.beliefs.estimates.tobytes()


def timeless(summary: dict[str, Any]) -> dict[str, Any]:
    """Without what the wall clock decides: costs, and by their number of digits the bytes of the messages with them."""
    network = {key: value for key, value in summary["network"].items() if key != "bytes_per_agent_s"}
    timed = ("wall_s", "real_time_factor", "estimator_ms", "network")
    return {key: value for key, value in summary.items() if key not in timed} | {"network": network}


def test_a_study_gives_the_same_numbers_with_one_and_with_two_processes(tmp_path: Path) -> None:
    grid = "agent.detector.P_D=0.8,0.85"
    one = study.run_all(study.jobs(EXPERIMENT, list(SMALL), range(5, 7), [grid]), 1, lambda _: None).summaries
    words = ["study", EXPERIMENT, *(word for change in SMALL for word in ("--set", change)), "--seeds", "5:7"]
    assert main([*words, "--grid", grid, "--jobs", "2", "--out", str(tmp_path)]) == 0
    two = json.loads((tmp_path / "study.json").read_text())
    assert [timeless(run) for run in one] == [timeless(run) for run in two["runs"]]
    assert [cell["grid"] for cell in two["cells"]] == [{"agent.detector.P_D": P_D} for P_D in (0.8, 0.85)]
    cell = two["cells"][0]
    assert cell["seeds"] == 2
    assert cell["relative_rmse_m"]["low"] < cell["relative_rmse_m"]["mean"] < cell["relative_rmse_m"]["high"]
    assert (tmp_path / "study.png").exists()


def test_a_study_run_is_the_run(flown: Flown) -> None:
    (job,) = study.jobs(EXPERIMENT, list(SMALL), range(5, 6), [])
    assert flown.result.summary is not None
    assert timeless(study.run_one(job)) == timeless(flown.result.summary) | {"grid": {}}


def test_a_run_that_fails_is_named_and_the_others_count(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = study.jobs("line", list(SMALL), range(5, 7), ["agent.detector.P_D=0.7"])

    def run_one(job: study.Job) -> dict[str, int]:
        if job.seed == 5:
            raise RuntimeError("it broke")
        return {"seed": job.seed}

    monkeypatch.setattr(study, "run_one", run_one)
    done = study.run_all(wanted, 1, lambda _: None)
    assert done.failures == ["seed 5, agent.detector.P_D=0.7: RuntimeError: it broke"]
    assert done.summaries == [{"seed": 6}]


def test_the_interval_of_a_mean_is_students() -> None:
    found = study.interval([1.0, None, 2.0, 3.0])
    assert found["mean"] == 2.0
    assert found["high"] == pytest.approx(2.0 + 4.302653 / np.sqrt(3))  # t of 2 degrees of freedom
    assert study.interval([None]) == {"mean": None, "low": None, "high": None}
    assert study.interval([4.0]) == {"mean": 4.0, "low": None, "high": None}


def test_a_run_in_one_process_that_breaks_off_says_why_and_is_scored(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = composition.fly

    def break_off(experiment: Experiment, epoch: int, record: Callable[[list[Packet]], None]) -> None:
        ticks = 0

        def record_some(packets: list[Packet]) -> None:
            nonlocal ticks
            ticks += 1
            if ticks > 20:
                raise ValueError("it broke")
            record(packets)

        before(experiment, epoch, record_some)

    monkeypatch.setattr(composition, "fly", break_off)
    outcome, summary = run(flown.experiment, tmp_path / "run", True, Quiet())
    log = tmp_path / "run" / "logs" / "run.txt"
    assert outcome.failure == f"the run broke off: ValueError: it broke (log: {log})"
    assert "Traceback" in log.read_text()
    assert summary is not None
    assert summary["ticks"] == 20
    assert summary["relative"]["rmse_m"] is None  # nothing to be scored within two seconds


def breaking(error: BaseException) -> Callable[..., None]:
    def broken(*_: object) -> None:
        raise error

    return broken


def test_a_scoring_that_fails_is_one_line_and_the_recording_is_kept(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(report, "draw_errors", breaking(np.linalg.LinAlgError("singular\nor so")))
    (tmp_path / "log.mcap").write_bytes((flown.folder / "log.mcap").read_bytes())
    log = tmp_path / "logs" / "scoring.txt"
    said = f"{tmp_path} could not be scored: LinAlgError: singular (log: {log}); `swarm score {tmp_path}` tries again"
    assert main(["score", str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"swarm: {said}\n"
    assert "Traceback" in log.read_text()
    monkeypatch.undo()
    assert main(["score", str(tmp_path)]) == 0


@pytest.mark.parametrize("how", [None, "it broke"])
def test_a_run_whose_scoring_fails_has_failed(
    how: str | None, flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_module, "_in_process", lambda *_: Outcome(failure=how))
    monkeypatch.setattr(run_module, "scored", breaking(FloatingPointError("overflow")))
    outcome, summary = run(flown.experiment, tmp_path, True, Quiet())
    assert outcome.failure is not None
    assert outcome.failure.startswith(f"{tmp_path} could" if how is None else f"it broke; {tmp_path} could")
    assert "could not be scored: FloatingPointError: overflow (log: " in outcome.failure
    assert summary is None


def test_who_interrupts_the_scoring_is_told_how_to_go_on(
    flown: Flown, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run_module, "scored", breaking(KeyboardInterrupt()))
    assert main(["score", str(tmp_path)]) == 130
    said = f"swarm: interrupted; {tmp_path} is not scored yet, `swarm score {tmp_path}` does it\n"
    assert capsys.readouterr().err == said


def test_the_finest_sensors_are_flown_and_scored() -> None:
    """At every floor at once: sensors that are so, and ordinary ones that are only believed to be."""
    detector = ("bearing_sigma_rad=1e-4", "range_sigma_offset_m=1e-4", "range_sigma_slope=0.0", "false_per_set=1e-6")
    reading = ("agent.filter.odometry_sigma_m=1e-6", "agent.filter.odometry_sigma_rad=1e-6")
    start = ("fleet.duration_s=2.5", "world.survey={position_sigma_m=1e-6, yaw_sigma_rad=1e-6}")
    for table in ("world", "agent"):
        changes = (*SMALL, *start, *reading, *(f"{table}.detector.{each}" for each in detector))
        assert study.run_one(study.Job(EXPERIMENT, changes, {}, 5))["relative"]["rmse_m"] < 1


def test_a_folder_is_shown_as_it_is_called(flown: Flown, capsys: pytest.CaptureFixture[str]) -> None:
    assert flown.result.summary is not None
    results.print_results(flown.result.summary, Path("x[bold]y[/bold]/[/i]z"))
    assert "x[bold]y[/bold]/[/i]z (errors: " in capsys.readouterr().out


def test_a_run_in_real_time_says_how_many_ticks_were_late(flown: Flown, capsys: pytest.CaptureFixture[str]) -> None:
    assert flown.result.summary is not None
    results.print_results(flown.result.summary, flown.folder)
    assert "late ticks" not in capsys.readouterr().out
    results.print_results(flown.result.summary | {"mode": "realtime", "late_ticks": 3}, flown.folder)
    assert "3 late ticks" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--grid", "fleet.mavs=2,2"], "--grid fleet.mavs: a value is given more than once"),
        (["--grid", "fleet.mavs=2", "--grid", "fleet.mavs=3"], "--grid fleet.mavs: given more than once"),
        (["--seeds", "0:100001"], "100001 runs: expected at most 100000"),
        (["--seeds", "0:99999999999"], "--seeds 0:99999999999: expected A:B"),
    ],
)
def test_a_study_that_makes_no_sense_is_refused(
    more: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["study", "line", "--seeds", "0:1", "--out", str(tmp_path / "new"), *more]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_ctrl_c_before_anything_has_begun_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(main_module, "_parser", interrupted)
    assert main(["list"]) == 130
    assert capsys.readouterr().err == "swarm: interrupted\n"
