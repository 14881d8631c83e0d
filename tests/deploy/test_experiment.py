"""Is an experiment read as it is written, changed as asked, and refused with exact words?"""

from pathlib import Path

import pytest

from agent.interface.tables import BadExperiment
from deploy.__main__ import main
from deploy.bundled import bundled
from deploy.composition import check
from deploy.experiment import from_text, load


def test_every_bundled_experiment_has_a_description_and_is_accepted(capsys: pytest.CaptureFixture[str]) -> None:
    assert {"paper_run_1", "paper_run_1_far", "line", "recorded_flights"} <= bundled().keys()
    for name, description in bundled().items():
        assert len(description) > 10
        if "recorded" not in name:  # needs files
            check(load(name), in_process=True)
    assert main(["list"]) == 0
    assert "paper_run_1 " in capsys.readouterr().out


def test_a_path_of_legs_fills_the_duration() -> None:
    for name in ("paper_run_1", "paper_run_1_far", "line"):
        experiment = load(name)
        legs = experiment.world["path"]
        assert sum(leg.get("move_s", 0) + leg["hold_s"] for leg in legs) == experiment.fleet.duration_s


def test_changes_are_toml_values_and_other_words_are_text() -> None:
    experiment = load(
        "line",
        ["fleet.mavs=3", "world.detector.P_D=0.7", "world.start_yaw=zero", "world.path.0.center=[0, 0, 2.0]"],
        seed=9,
        realtime=True,
    )
    assert (experiment.fleet.mavs, experiment.fleet.seed, experiment.fleet.realtime) == (3, 9, True)
    assert experiment.world["detector"]["P_D"] == 0.7
    assert experiment.world["start_yaw"] == "zero"
    assert experiment.world["path"][0]["center"] == [0, 0, 2.0]


def test_an_agent_knows_its_sensors_unless_told_otherwise() -> None:
    changes = ["world.detector.P_D=0.7", "world.detector.max_range_m=9.0", "agent.detector.P_D=0.8"]
    experiment = load("line", [*changes, "world.odometry.yaw_sigma_rad=0.004"])
    assert experiment.agent == {"detector": {"P_D": 0.8, "max_range_m": 9.0}, "odometry": {"yaw_sigma_rad": 0.004}}
    assert load("line").agent == {}


def test_a_resolved_file_is_an_experiment_that_resolves_to_itself(tmp_path: Path) -> None:
    first = load("line", ["world.detector.P_D=0.7", "faults.loss=0.3"], seed=4)
    assert first.faults.loss == 0.3
    path = tmp_path / "anything.toml"
    path.write_text(first.toml())
    assert load(str(path)) == first == from_text(first.toml())
    assert load(str(path)).name == "line"


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["nowhere"], "nowhere: no such experiment; bundled are bad_network, cold_start, "),
        (["line", "--set", "wrld.P_D=1"], "--set wrld.P_D=1: there is no table 'wrld'"),
        (["line", "--set", "fleet.mavs"], "--set fleet.mavs: expected TABLE.KEY=VALUE"),
        (["line", "--set", "mavs=3"], "--set mavs=3: expected TABLE.KEY=VALUE"),
        (["line", "--set", "fleet.mavs=[3"], "--set fleet.mavs=[3: not a TOML value"),
        (["line", "--set", "fleet.mavs.x=3"], "--set fleet.mavs.x=3: mavs = 7 is not a table"),
        (["line", "--set", "world.path.7.hold_s=3"], "--set world.path.7.hold_s=3: '7' of an array: expected a number"),
        (["line", "--set", f"world.path.{'9' * 5000}.hold_s=3"], "9' of an array: expected a number, 0 to 4"),
        (["line", "--set", f"fleet.seed={'9' * 5000}"], "9: not a TOML value: Exceeds the limit (4300 digits)"),
        (["line", "--set", f"fleet.seed={'[' * 3000}"], "[: not a TOML value: "),
        (["line", "--set", f"fleet.rate_hz={'9' * 400}"], "9: number out of range"),
        (
            ["line", "--set", "fleet.mavs=3\nrate_hz=5"],
            r"--set 'fleet.mavs=3\nrate_hz=5': expected one value, more keys",
        ),
        (["line", "--set", "fleet.mvs=3"], "fleet.mvs: there is no such key"),
        (["line", "--set", "fleet.mavs=many"], "fleet.mavs = 'many': expected int, got str"),
        (["line", "--set", "fleet.mavs=500"], "mavs = 500: expected 1 to 50"),
        (["line", "--set", "agent.detector.P_D=2"], "_D = 2"),
        (["line", "--set", "agent.detector=3"], "agent.detector"),
        (["line", "--set", "world.detectr.P_D=0.5"], "world.detectr: there is no such key"),
        (["line", "--set", "world.path.1.move_s=0.1"], "world.path[1].move_s = 0.1"),
        (["line", "--set", "faults.loss=1.3"], "faults.loss = 1.3: expected a share, 0 to 1"),
        (["line", "--set", "faults.los=0.3"], "faults.los: there is no such key"),
        (["line", "--realtime", "--in-process"], "fleet.realtime = true: in one process there is no real time"),
        (["recorded_flights"], "world.flights_dir"),
        (
            ["recorded_flights", "--set", r'world.flights_dir="a\u0000b"'],
            r"cannot read 'a\x00b/gt_V2_01.txt': embedded",
        ),
    ],
)
def test_bad_input_is_one_line_and_starts_nothing(
    words: list[str],
    complaint: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "out"
    assert main(["run", *words, "--out", str(out)]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("swarm: ")
    assert said.err.count("\n") == 1
    assert complaint in said.err
    assert not out.exists()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("fleet = 3", "fleet = 3: expected a table, [fleet]"),
        ("[wrld]\nx = 1", "wrld: there is no such table; expected world, agent, fleet, faults"),
        ("[fleet\n", "cannot be read as TOML"),
        (f"[fleet]\nseed = {'9' * 5000}", "cannot be read as TOML: Exceeds the limit (4300 digits)"),
        (f"[fleet]\nseed = {'[' * 3000}", "cannot be read as TOML: "),
        (
            '[record]\nexperiment = "a/../../b"',
            "'a/../../b': no experiment can be called that, expected UTF-8 without /",
        ),
        ('[record]\nexperiment = "a\\u0000b"', "'a\\x00b': no experiment can be called that"),
    ],
    ids=lambda words: words[:40],
)
def test_a_bad_file(text: str, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(BadExperiment) as caught:
        load(str(path))
    assert complaint in str(caught.value)
    with pytest.raises(BadExperiment):
        from_text(text)


def test_what_is_not_utf_8_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadExperiment, match="not a TOML value: 'utf-8' codec can't encode"):
        load("line", ["fleet.se\udcffd=1"])
    path = tmp_path / "mine\udcff.toml"
    path.write_text("")
    with pytest.raises(BadExperiment, match="no experiment can be called that, expected UTF-8"):
        load(str(path))


def test_a_byte_order_mark_is_no_part_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("[fleet]\nseed = 3\n", "utf-8-sig")
    assert load(str(path)).fleet.seed == 3


@pytest.mark.parametrize(
    "words",
    [["run", "line", "--out", ""], ["study", "line", "--seeds", "0:1", "--out", ""], ["score", ""], ["report", ""]],
)
def test_an_empty_path_is_not_the_working_directory(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 2
    assert "expected a path, not nothing" in capsys.readouterr().err


def test_out_must_be_new_or_empty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "something").write_text("precious")
    assert main(["run", "line", "--in-process", "--out", str(tmp_path)]) == 2
    assert main(["study", "line", "--seeds", "0:1", "--out", str(tmp_path / "something")]) == 2
    assert "does not exist yet or is empty" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["something"]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--seeds", "3"], "--seeds 3: expected A:B"),
        (["--seeds", "3:3"], "--seeds 3:3: expected A:B"),
        (["--seeds", "0:2", "--grid", "agent.detector.P_D"], "expected TABLE.KEY=VALUE,VALUE"),
        (["--seeds", "0:2", "--grid", "agent.detector.P_D=0.5,7"], "_D = 7"),
        (["--seeds", "0:2", "--grid", "fleet.seed=1,2"], "the seeds are what --seeds says"),
        (["--seeds", "0:2", "--grid", "faults.delay_ms=0,-1"], "faults.delay_ms = -1.0: expected 0 to 60000 ms"),
        (["--seeds", "0:2", "--jobs", "0"], "--jobs 0: expected 1 or more"),
    ],
)
def test_a_bad_study(words: list[str], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "line", *words, "--out", str(tmp_path / "out")]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
