"""One agent as a process: does it hold, say so and go, and does a second one with its number not start?"""

import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.system
EXPERIMENT = """
[fleet]
mavs = 2
realtime = true
[agent]
hold_after_s = 0.3
"""


@pytest.fixture
def folder():
    with tempfile.TemporaryDirectory() as name:  # a short path: socket paths hold 108 characters
        folder = Path(name)
        (folder / "experiment.toml").write_text(EXPERIMENT)
        network = {"name": "mav_1", "namespace": "swarm/7", "listen": [f"unixsock-stream/{folder}/mav_1"]}
        (folder / "network.json").write_text(json.dumps(network | {"lossless": False, "everyone": ["mav_1"]}))
        yield folder


def agent(folder):
    words = [folder / "experiment.toml", "--network", folder / "network.json", "--epoch", "7", "--mav", "1"]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen([sys.executable, "-m", "agent", *words], stderr=subprocess.PIPE, text=True, env=environment)


def test_without_a_world_it_holds_and_a_second_one_does_not_start(folder):
    with agent(folder) as first:
        said = first.stderr.readline()
        assert said.startswith("WARNING agent: nothing from its own sensors for 0.")
        assert said.endswith("s: holding\n")
        with agent(folder) as second:
            assert second.wait(20) == 1
            assert second.stderr.read() == (
                f"ERROR agent: mav_1: MAV 1 is already flying, at unixsock-stream/{folder}/mav_1\n"
            )
        first.send_signal(signal.SIGTERM)
        assert first.wait(20) == 128 + signal.SIGTERM
        assert first.stderr.read() == ""
