"""How well does a team fly formations on board? The table of flights: `make formations` (half an hour)

`SEEDS=0:2` flies fewer runs of each row, `ROWS="line a"` some rows only.
"""

import json
import math
import os
import sys
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported

from deploy import study

FOLDER = Path("runs/formations")
ON_THE_WAY_S = 8.5  # when most are half-way to the line
LONG = ("fleet.duration_s=180.0", "agent.mission.legs.0.hold_s=600.0")
# Told exactly where all began, and blind: what is left is everybody's odometry.
RECKONED = (
    "world.survey={position_sigma_m=0.001, yaw_sigma_rad=0.001}",
    "world.detector.max_range_m=0.5",
    "agent.localised_sigma_m=50.0",
    "agent.localised_sigma_rad=5.0",
)


def killed(mav: int) -> str:
    return f'faults.processes=[{{mav={mav}, do="kill", at_s={ON_THE_WAY_S}}}]'


# Of each row the experiment, what is changed in it, and how many seeds.
ROWS: dict[str, tuple[str, tuple[str, ...], int]] = {
    "line": ("formation_line", (), 20),
    "line, 20 % lost, 100 ms": ("formation_line", ("faults.loss=0.2", "faults.delay_ms=100"), 10),
    "line, leader killed": ("formation_line", (killed(1), "fleet.duration_s=35.0"), 10),
    "line, another killed": ("formation_line", (killed(4),), 10),
    "line, gusts of 1 m/s": ("formation_line", ("world.wind.gust_sigma_m_s=1.0",), 5),
    "a": ("sequence_a", (), 5),
    "b": ("sequence_b", (), 5),
    "c": ("sequence_c", (), 5),
    "a, planned once": ("sequence_a", ("agent.mission.replan_beyond_m=inf",), 3),
    "line, 3 min": ("formation_line", LONG, 3),
    "line, 3 min, reckoned": ("formation_line", LONG + RECKONED, 3),
}


def line(name: str, runs: list[dict[str, Any]]) -> str:
    """One line of the table."""
    flights = [run["flight"] for run in runs]
    last = [math.inf if each["formation_rms_m"] is None else each["formation_rms_m"] for each in flights]
    legs = [leg["rms_m"] for each in flights for leg in each["formations"]]
    reached = sum(leg is not None for leg in legs)
    worst = max((leg for leg in legs if leg is not None), default=math.inf)
    nearest, touched = min(each["nearest_m"] for each in flights), sum(each["collisions"] for each in flights)
    wrong = sum(mav["wrong_commits"] for run in runs for mav in run["mavs"])
    mean = sum(last) / len(last)
    return (
        f"| {name} | {len(runs)} | {reached} of {len(legs)} | {worst:.3f} | {mean:.3f} / {max(last):.3f}"
        f" | {nearest:.2f} | {touched} | {wrong} |"
    )


def main(asked: str, *names: str) -> int:
    FOLDER.mkdir(parents=True, exist_ok=True)
    processes = int(os.environ.get("JOBS", os.cpu_count() or 1))
    lines = [
        "| flight | seeds | legs reached | worst leg RMS m | last 5 s RMS m, mean / worst | nearest m | touched | wrong"
        " commits |",
        "|---|---|---|---|---|---|---|---|",
    ]
    print(*lines, sep="\n")
    for name, (source, changes, most) in ROWS.items():
        if names and name not in names:
            continue
        seeds = range(*map(int, asked.split(":"))) if asked else range(most)
        jobs = [study.Job(source, changes, {}, seed) for seed in seeds]
        result = study.run_all(jobs, processes, lambda _: None)
        if result.failures or result.interrupted:
            print(*result.failures, sep="\n")
            return 1
        (FOLDER / f"{name.replace(' ', '_').replace(',', '').replace('/', '_')}.json").write_text(
            json.dumps(result.summaries)
        )
        lines.append(line(name, result.summaries))
        print(lines[-1], flush=True)
    (FOLDER / "table.md").write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(*(sys.argv[1:] or [""])))
