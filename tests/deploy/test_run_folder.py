"""Whose is a folder, and what if it cannot be had?"""

from pathlib import Path

import pytest

from agent.interface import clock
from deploy import study
from deploy.__main__ import main
from deploy.run_folder import folder_for


@pytest.mark.parametrize("words", [["run", "line"], ["study", "line", "--seeds", "0:1"]])
def test_a_folder_that_cannot_be_made_is_refused_before_anything_starts(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main([*words, "--out", str(tmp_path / "file" / "sub")]) == 2
    said = capsys.readouterr().err
    assert said.startswith("swarm: --out")
    assert said.count("\n") == 1
    assert "cannot be made: Not a directory" in said


def test_a_study_without_a_result_leaves_the_folder_that_it_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = study.Study([], ["seed 0: it broke"], False)
    monkeypatch.setattr(study, "run_all", lambda *_: nothing)
    assert main(["study", "line", "--seeds", "0:1", "--out", str(tmp_path)]) == 1
    assert list(tmp_path.iterdir()) == []


def test_nobody_else_gets_a_folder_that_is_being_written_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["study", "line", "--seeds", "0:1", "--out", str(tmp_path)]
    seconds: list[int] = []

    def meanwhile(*_: object) -> study.Study:
        seconds.append(main(words))
        return study.Study([], ["seed 0: it broke"], False)

    monkeypatch.setattr(study, "run_all", meanwhile)
    assert main(words) == 1
    assert seconds == [2]
    assert f"--out {tmp_path}: expected a directory that does not exist yet or is empty" in capsys.readouterr().err


def test_runs_that_begin_in_the_same_second_have_a_folder_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(clock, "utc_text", lambda: "20260131-235959")
    folders = [str(folder_for("line", None)) for _ in range(3)]
    assert folders == ["runs/line-20260131-235959", "runs/line-20260131-235959-2", "runs/line-20260131-235959-3"]


def test_no_folder_where_runs_is_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").touch()
    assert main(["run", "line"]) == 2
    assert "cannot be made: Not a directory" in capsys.readouterr().err
