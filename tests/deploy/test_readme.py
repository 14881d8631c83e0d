"""Is what the README says true? Its commands are run, its experiment is flown, its driver drives."""

import re
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from deploy import by_hand
from deploy.__main__ import BAD_INPUT, FINE, main
from deploy.experiment import load
from tests.deploy.conftest import Flown

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text()
COMMANDS = [
    shlex.split(command.partition("#")[0])[1:]
    for command in re.findall(r"^    (?:\.venv/bin/)?(swarm .*)$", TEXT, re.MULTILINE)
]
NEEDS_MORE = {
    "view": "the viewer has tests of its own",
    "recorded_flights": "needs recordings that are not part of this",
}
BY_HAND = ("world", "agent", "recorder")  # run for real in tests/deploy/test_by_hand.py


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)


EXPERIMENT = next(block for block in blocks("toml") if block.startswith("# five MAVs"))


def test_there_are_commands_of_every_kind() -> None:
    kinds = {command[0] for command in COMMANDS}
    assert kinds == {"run", "study", "score", "report", "list", "view", "export", *BY_HAND}


@pytest.mark.timeout(300)
@pytest.mark.parametrize("command", [each for each in COMMANDS if each[0] not in BY_HAND], ids=" ".join)
def test_a_command_does_what_it_is_to_do(
    command: list[str],
    flown: Flown,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As it stands there, but shorter."""
    for word, why in NEEDS_MORE.items():
        if word in command:
            pytest.skip(why)
    if "--view" in command:
        pytest.skip(NEEDS_MORE["view"])
    monkeypatch.chdir(tmp_path)
    Path("my_experiment.toml").write_text(EXPERIMENT)
    for name in ("DIR", "DIR2"):
        by_name = tmp_path / "runs" / name
        by_name.parent.mkdir(exist_ok=True)
        by_name.symlink_to(flown.folder)
    words = [*command]
    if command[0] in ("run", "study"):
        words += ["--set", "fleet.duration_s=0.7"]
        if "cut_and_crash" in command:
            words += ["--set", "faults.partitions=[]", "--set", "faults.processes=[]"]  # they come later
        if command[0] == "study":
            words[words.index("--seeds") + 1] = "0:1"
            words += ["--jobs", "1"]
        elif "--realtime" not in words and "--in-process" not in words:
            words.append("--in-process")
    if command[0] == "export":
        words += ["--out", str(tmp_path / "exported")]
    if len(command) > 1 and command[0] == "report":
        words += ["--out", str(tmp_path / "page.html")]
    if words == ["report", "runs/DIR", "runs/DIR2", "--out", str(tmp_path / "page.html")]:
        (tmp_path / "runs" / "DIR2").unlink()  # the same run is not compared with itself
        words.remove("runs/DIR2")
    assert main(words) == FINE


def test_its_experiment_is_one(tmp_path: Path) -> None:
    file = tmp_path / "my_experiment.toml"
    file.write_text(EXPERIMENT)
    assert load(str(file)).fleet.mavs == 5


def test_its_other_tables_belong_into_an_experiment(tmp_path: Path) -> None:
    from deploy.composition import check

    for block in blocks("toml"):
        if not block.startswith("# network.toml"):
            file = tmp_path / "part.toml"
            path = (
                ""
                if "[world]" in block or "world.path" in block
                else '[[world.path]]\nformation = "box"\nsize_m = [5.0, 5.0, 1.0]\n'
            )
            file.write_text(block + path)
            check(load(str(file)), in_process=True)


def test_wrong_words_are_refused_with_the_status_that_it_says() -> None:
    assert main(["run", "no_such_experiment"]) == BAD_INPUT


@pytest.mark.system
def test_its_driver_drives(tmp_path: Path) -> None:
    (driver,) = blocks("python")
    assert driver.startswith("# driver.py")
    experiment = tmp_path / "two.toml"
    experiment.write_text("[fleet]\nmavs = 2\nrealtime = true\n")
    network = tmp_path / "network.toml"
    network.write_text("".join(f"mav_{mav} = 'unixsock-stream/{tmp_path}/{mav}'\n" for mav in (1, 2)))
    loaded = load(str(experiment))
    where = by_hand.places(network, loaded)
    drivers = []
    for mav in (1, 2):
        text = driver.replace("MAV, EPOCH", "_, EPOCH").replace("AGENT =", f"MAV = {mav}\nAGENT =")
        file = tmp_path / f"driver_{mav}.py"
        file.write_text(text.replace("tcp/127.0.0.1:7451", where[f"mav_{mav}"].listen))
        drivers.append(
            subprocess.Popen(
                [sys.executable, str(file)], cwd=ROOT, stdout=subprocess.PIPE, text=True, env={"PYTHONPATH": str(ROOT)}
            )
        )
    with ThreadPoolExecutor() as threads:
        agents = [threads.submit(by_hand.run, loaded, where, f"mav_{mav}", 7) for mav in (1, 2)]
        assert [agent.result() for agent in agents] == [0, 0]
    for each in drivers:
        said, _ = each.communicate()
        assert each.returncode == 0
        assert int(said.split()[0]) >= 20  # of thirty ticks; the last are answered when it is gone
