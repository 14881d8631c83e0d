"""Does a swarm survive ten minutes of random kills and stops, and does nobody's memory grow? `make soak`

Seven MAVs in real time; at random, one of them is killed and restarted some seconds later, or stopped and continued.
`make soak SECONDS=60` is a short one. Exit status 1 if the run failed, a process was left, or the memory of one that
lived for long grew by more than a tenth (and 2 MB) in its second half.
"""

import json
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import msgspec
import numpy as np
import psutil

from agent.interface import clock
from agent.interface.seeds import generator
from deploy import faults, fleet, supervisor
from deploy.experiment import load
from deploy.process_faults import Director
from deploy.progress import Progress

MAVS, EPOCH = 7, 2**30
BEGIN_S, PAUSE_S, AWAY_S = 5.0, (2.0, 8.0), (0.5, 8.0)
LONG_S, GROWTH, SLACK_MB = 30.0, 1.1, 2.0


def schedule(duration_s: float) -> list[dict[str, object]]:
    """Rows of [[faults.processes]]: one MAV after another, sometimes several at once."""
    rng, verbs = generator(0, "soak"), []
    free_s = dict.fromkeys(range(1, MAVS + 1), 0.0)
    now_s = BEGIN_S
    while now_s < duration_s - AWAY_S[1] - 5:
        mav = int(rng.choice([each for each, free in free_s.items() if free <= now_s]))
        away_s = float(rng.uniform(*AWAY_S))
        for do, at_s in zip((("kill", "restart"), ("stop", "continue"))[rng.integers(2)], (0, away_s), strict=True):
            verbs.append({"mav": mav, "do": do, "at_s": round(now_s + at_s, 1)})
        free_s[mav] = now_s + away_s + 5
        now_s += float(rng.uniform(*PAUSE_S))
    return verbs


class Memory:
    """Resident memory of every process of the run, each time the recorder reports."""

    def __init__(self) -> None:
        self.series: dict[tuple[str, int], list[tuple[float, float]]] = defaultdict(list)  # s, MB
        self.states = "nothing"

    def look(self, line: bytes) -> None:
        progress = msgspec.json.decode(line, type=Progress)
        self.states = f"{progress.sim_s:.0f} s, {sum(mav.state == 'localised' for mav in progress.mavs)} localised"
        print(f"\r{self.states}   ", end="", flush=True)
        for child in psutil.Process().children():
            try:
                words = child.cmdline()
                name = f"mav_{words[words.index('--mav') + 1]}" if "--mav" in words else words[2].split(".")[-1]
                self.series[name, child.pid].append((clock.now_s(), child.memory_info().rss / 1e6))
            except (psutil.Error, ValueError, IndexError):
                continue  # it has just been killed, or is not one yet

    def growth(self) -> dict[str, tuple[float, float]]:
        """Of those that lived for long: the median of its third quarter and of its last one, MB."""
        found = {}
        for (name, pid), samples in self.series.items():
            times, sizes = np.array(samples).T
            if times[-1] - times[0] > LONG_S:
                quarters = np.array_split(sizes, 4)
                found[f"{name} ({pid})"] = (float(np.median(quarters[2])), float(np.median(quarters[3])))
        return found


def main(duration_s: float) -> int:
    changes = (f"fleet.mavs={MAVS}", f"fleet.duration_s={duration_s}", "fleet.realtime=true")
    experiment = load("cold_start", changes, seed=0)
    experiment = experiment._replace(faults=faults.parse({"processes": schedule(duration_s)}, experiment.fleet))
    memory = Memory()
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        folder = Path(name)
        (folder / "experiment.toml").write_text(experiment.toml())
        where = fleet.on_one_host(experiment.fleet, folder)
        table = fleet.processes(experiment.fleet, folder, folder, EPOCH, where, experiment.faults)
        director = Director(experiment.faults, experiment.fleet)
        outcome = supervisor.run(table, folder, memory.look, director)
        left = [child for child in psutil.process_iter(["cmdline"]) if name in " ".join(child.info["cmdline"] or ())]
        said = {path.stem: path.read_text()[-2000:] for path in folder.glob("*.txt")} if outcome.failure else {}
    grown = {
        who: sizes
        for who, sizes in memory.growth().items()
        if sizes[1] > GROWTH * sizes[0] and sizes[1] > sizes[0] + SLACK_MB
    }
    found = {
        "seconds": duration_s,
        "kills_and_stops": len(experiment.faults.processes) // 2,
        "failure": outcome.failure,
        "left": [child.pid for child in left],
        "memory_mb": memory.growth(),
        "grown": sorted(grown),
        "last": memory.states,
    }
    Path("runs").mkdir(exist_ok=True)
    Path("runs/soak.json").write_text(json.dumps(found | {"logs": said}, indent=2) + "\n")
    print("\n" + json.dumps(found, indent=2))
    return 0 if outcome == supervisor.Outcome() and not left and not grown else 1


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]) if len(sys.argv) > 1 else 600.0))
