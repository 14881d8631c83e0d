"""Can every process of a run be started by hand, as on several hosts, and is a wrong table of endpoints refused?"""

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from deploy import by_hand
from deploy.__main__ import main
from deploy.experiment import load

EXPERIMENT = """
[fleet]
mavs = 2
duration_s = 1.5
realtime = true
[[world.path]]
formation = "circle"
radius_m = 1.0
"""


def written(folder: Path, network: str) -> list[str]:
    (folder / "two.toml").write_text(EXPERIMENT)
    (folder / "network.toml").write_text(network)
    return [str(folder / "two.toml"), "--network", str(folder / "network.toml"), "--epoch", "7"]


def heed() -> None:
    """A shell that starts the tests in the background has them, and all they start, ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.mark.system
def test_a_run_of_processes_started_by_hand(tmp_path: Path) -> None:
    names = ("recorder", "world", "mav_1", "mav_2")
    words = written(tmp_path, "".join(f"{name} = 'unixsock-stream/{tmp_path}/{name}'\n" for name in names))
    experiment = load(words[0])
    where = by_hand.places(tmp_path / "network.toml", experiment)
    program = [sys.executable, "-m", "deploy", "recorder", *words, "--out", str(tmp_path / "run")]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    with (
        subprocess.Popen(program, stdout=subprocess.PIPE, text=True, env=environment, preexec_fn=heed) as recorder,
        ThreadPoolExecutor() as threads,
    ):
        others = [threads.submit(by_hand.run, experiment, where, name, 7) for name in names[1:]]
        assert [other.result() for other in others] == [0, 0, 0]
        recorder.send_signal(signal.SIGINT)
        assert "clairvoyant" in recorder.communicate()[0]
        assert recorder.returncode == 0
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["ticks"] == 15


ALL = "world = 'tcp/10.0.0.1:1'\nmav_1 = 'tcp/10.0.0.1:2'\nmav_2 = 'tcp/10.0.0.1:3'\n"


@pytest.mark.parametrize(
    ("command", "network", "says"),
    [
        (["world"], "world =", "cannot be read as TOML"),
        (["world"], "world = 'tcp/10.0.0.1:1'", "mav_1 is missing, expected an endpoint as in tcp/10.0.0.1:7447"),
        (
            ["world"],
            ALL + "mav_3 = 'tcp/10.0.0.1:4'",
            "mav_3: there is no such process, expected recorder, world",
        ),
        (["world"], ALL.replace("'tcp/10.0.0.1:3'", "7447"), "mav_2 = 7447: expected as in 'tcp/10.0.0.1:7447'"),
        (["world"], ALL.replace("tcp/10.0.0.1:3", "tcp/10.0.0.1"), "mav_2 = 'tcp/10.0.0.1': expected as in"),
        (["world"], ALL.replace("10.0.0.1:3", "10.0.0.1:70000"), "mav_2 = 'tcp/10.0.0.1:70000': expected as in"),
        (["world"], ALL.replace("tcp/10.0.0.1:3", "pigeon/10.0.0.1:3"), "mav_2 = 'pigeon/10.0.0.1:3': expected as in"),
        (["world"], ALL.replace("10.0.0.1:3", "10.0.0.1:2"), "mav_2 = 'tcp/10.0.0.1:2': mav_1 has the same"),
        (["agent", "--mav", "3"], ALL, "--mav 3: expected 1 to 2"),
        (["world", "--set", "faults.processes=[{mav=1,do='kill',at_s=1}]"], ALL, "faults.processes: expected none"),
        (["recorder"], ALL, "recorder is missing, expected an endpoint"),
    ],
)
def test_a_wrong_table_of_endpoints_is_refused(
    command: list[str], network: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command[0], *written(tmp_path, network), *command[1:]]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    "endpoint", ["udp/robot-3.local:7447?rel=1", "tls/[fe80::1%eth0]:1#a=b", "quic/h:65535", "ws/h:1"]
)
def test_every_kind_of_endpoint_is_taken(endpoint: str, tmp_path: Path) -> None:
    words = written(tmp_path, ALL.replace("tcp/10.0.0.1:3", endpoint))
    assert by_hand.places(tmp_path / "network.toml", load(words[0]))["mav_2"].listen == endpoint


@pytest.mark.parametrize("epoch", ["-1", "1" + 18 * "0", 5000 * "1", "x"])
def test_an_epoch_that_no_message_can_hold_is_refused(
    epoch: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as refused:
        main(["world", *written(tmp_path, ALL)[:-1], epoch])
    assert refused.value.code == 2
    assert "expected a number of at most 18 digits" in capsys.readouterr().err
