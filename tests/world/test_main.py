"""Does `python -m world` run by itself, and refuse a wrong experiment with one line?"""

import json
import subprocess
import sys
from pathlib import Path

EXPERIMENT = """
[fleet]
mavs = 2
duration_s = 0.5
realtime = true
[[world.path]]
formation = "circle"
radius_m = {radius_m}
"""


def run(folder: Path, radius_m: float) -> subprocess.CompletedProcess[str]:
    experiment, network = folder / "experiment.toml", folder / "network.json"
    experiment.write_text(EXPERIMENT.format(radius_m=radius_m))
    network.write_text(json.dumps({"name": "world", "namespace": "swarm/test_main", "everyone": ["world"]}))
    command = [sys.executable, "-m", "world", str(experiment), "--network", str(network), "--epoch", "1"]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, stdin=subprocess.DEVNULL)


def test_a_run_in_real_time_ends_by_itself(tmp_path: Path) -> None:
    done = run(tmp_path, 1.0)
    assert (done.returncode, done.stdout) == (0, "ready\n"), done.stderr


def test_a_wrong_experiment_is_one_line_and_exit_2(tmp_path: Path) -> None:
    done = run(tmp_path, 0.1)
    assert done.returncode == 2
    assert done.stderr.startswith("world: world.path[0]: when there MAVs 1 and 2 are 0.20 m apart, expected at least")
    assert done.stderr.count("\n") == 1
