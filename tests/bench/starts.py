"""From which starts, and how fast, does a team localise itself? The table of starts: `make starts` (hours)

`SEEDS=0:20` flies fewer runs of each row, `ROWS="box_7 line"` some rows only. Every row is a study; what is flown of it
is kept in runs/starts/ROW.json, a run a seed, and is not flown again: an interrupted table goes on where it was.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported

from deploy import study

FOLDER = Path("runs/starts")
TAKE_OFF_S = 1.0  # when it begins

# Of each row the experiment and what is changed in it.
ROWS: dict[str, tuple[str, tuple[str, ...]]] = {
    **{f"box_{mavs}": ("cold_start", (f"fleet.mavs={mavs}",)) for mavs in (3, 5, 7, 9, 12)},
    "line": ("cold_start_line", ()),
    "v": ("cold_start", ('world.path=[{formation="v", length_m=4.2, jitter_m=0.3, hold_s=6.0}]',)),
    "circle": ("cold_start", ('world.path=[{formation="circle", radius_m=2.7, jitter_m=0.3, hold_s=6.0}]',)),
    "take_off": ("cold_start_circle", ()),
    "circle_nearly_regular": (
        "cold_start",
        ('world.path=[{formation="circle", radius_m=1.35, jitter_m=0.02, hold_s=6.0}]',),
    ),
    "circle_regular": ("cold_start_symmetric", ()),
    "line_regular": ("cold_start_line", ("world.path.0.jitter_m=0.0",)),
    "box_poor_detector": ("cold_start", ("world.detector.P_D=0.7", "world.detector.false_per_set=1.0")),
    "box_lost_and_late": (
        "cold_start",
        ('faults.links=[{topics=["detections"], loss=0.3, delay_ms=100}]',),
    ),
    "recorded": ("cold_start_recorded", ()),  # where DATASETS says: world.flights_dir
}


def flown(name: str, seeds: range, changes: tuple[str, ...], processes: int) -> list[dict[str, Any]]:
    """The summaries of this row's runs; those that were not there are flown now, some at a time."""
    file = FOLDER / f"{name}.json"
    runs = {run["seed"]: run for run in (json.loads(file.read_text()) if file.exists() else [])}
    source, own = ROWS[name]
    missing = [seed for seed in seeds if seed not in runs]
    jobs = [study.Job(source, own + changes, {}, seed) for seed in missing]
    some = 10 * processes
    for first in range(0, len(jobs), some):
        result = study.run_all(jobs[first : first + some], processes, lambda _: None)
        if result.failures:
            sys.exit(f"{name}: {result.failures[0]}")
        runs |= {run["seed"]: run for run in result.summaries}
        file.write_text(json.dumps([runs[seed] for seed in sorted(runs)]))
        print(f"{name}: {len([seed for seed in seeds if seed in runs])} of {len(seeds)}", flush=True)
        if result.interrupted:
            sys.exit(130)
    return [runs[seed] for seed in seeds]


def line(name: str, runs: list[dict[str, Any]]) -> str:
    """One line of the table."""
    (cell,) = study.evaluate(runs, name, "")["cells"]
    begun_s = TAKE_OFF_S if name == "take_off" else 0.0
    times = sorted(at for at in cell["values"]["localised_at_s"] if at is not None)
    last = f"{times[-1] - begun_s:.1f}" if times else "-"
    p95, wrong = cell["localised_at_s"]["p95"], cell["wrong_commits"]

    def mean(metric: str, digits: int) -> str:
        value = cell[metric]["mean"]
        return "-" if value is None else f"{value:.{digits}f}"

    return (
        f"| {name} | {len(runs)} | {100 * cell['all_localised']:.1f} %"
        f" | {'-' if p95 is None else f'{p95 - begun_s:.1f}'} / {last} | {wrong['total']} in {wrong['runs']}"
        f" | {100 * cell['ambiguous_to_the_end']:.0f} % | {mean('commit_nees', 2)} | {mean('position_1s_m', 3)}"
        f" | {mean('yaw_1s_rad', 4)} | {mean('ratio_to_clairvoyant', 3)} |"
    )


def main(seeds: str, *asked: str) -> int:
    """Rows to fly (all if none is named), and changes ("PATH=VALUE") for all of them."""
    first, last = map(int, seeds.split(":"))
    names = [each for each in asked if "=" not in each] or list(ROWS)
    changes = tuple(each for each in asked if "=" in each)
    FOLDER.mkdir(parents=True, exist_ok=True)
    processes = int(os.environ.get("JOBS", os.cpu_count() or 1))
    lines = [
        "| start | seeds | all localised | 95 % / latest s | wrong commits | all ambiguous to the end | NEES at commit"
        " | +1 s m | +1 s rad | x told twin |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name in names:
        lines.append(line(name, flown(name, range(first, last), changes, processes)))
        print(lines[-1], flush=True)
    (FOLDER / "table.md").write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(*(sys.argv[1:] or ["0:200"])))
