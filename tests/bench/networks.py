"""What does a bad network cost? The table of faults: `make networks` (SEEDS=0:2 for a short one)

Seven MAVs fly 32 s of `cut_and_crash`'s circles from an unknown start: on a perfect network, and with each fault.
Errors are of pairs that are alive and connected, beside the same pairs at the same times on the perfect network, and
beside the told twin on the same faulted recording.
"""

import json
import math
import os
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported

import numpy as np

from deploy import summary
from deploy.study import Job, analysed

CUT_S, HEALED_S, AGAIN_S = 8.0, 18.0, 20.0  # of the partition, and when all should be as before
KILLED = 2  # the MAV that is
BASE = ("fleet.duration_s=32.0", "faults.partitions=[]", "faults.processes=[]")
OURS, PERFECT, TWIN = "ours", "perfect", "twin"


def lives(*times_s: tuple[float, float]) -> str:
    """Killed and started again at these times."""
    verbs = [
        f'{{mav={KILLED}, do="{do}", at_s={at_s}}}'
        for pair in times_s
        for do, at_s in zip(("kill", "restart"), pair, strict=True)
    ]
    return f"faults.processes=[{', '.join(verbs)}]"


ROWS: dict[str, tuple[str, ...]] = {
    "10 % loss, 50 ms": ("faults.loss=0.1", "faults.delay_ms=50"),
    "30 % loss, 200 +- 50 ms": ("faults.loss=0.3", "faults.delay_ms=200", "faults.jitter_ms=50"),
    "50 % loss in bursts, duplicates, reordered": (
        "faults.burst_loss=0.5",
        "faults.duplicates=0.1",
        "faults.reorder=0.1",
    ),
    "500 ms": ("faults.delay_ms=500",),
    "partition 3 + 4": (f"faults.partitions=[{{groups=[[1,2,3],[4,5,6,7]], from_s={CUT_S}, until_s={HEALED_S}}}]",),
    "killed, back after 5 s": (lives((10.0, 15.0)),),
    "killed three times": (lives((8.0, 10.0), (14.0, 16.0), (20.0, 22.0)),),
    "own detections only, from 4 s on": ('faults.links=[{topics=["detections"], loss=1.0, from_s=4.0}]',),
}


def fly(seed: int) -> dict[str, dict[str, Any]]:
    """Of every row: squared errors and how many, by what they are of; and what summary.json says."""
    perfect = analysed(Job("cut_and_crash", BASE, {}, seed))[0].ours
    found = {}
    for name, changes in ROWS.items():
        analysis, circumstances = analysed(Job("cut_and_crash", BASE + changes, {}, seed))
        said = summary.summarise(analysis, circumstances)
        time_s = analysis.recording.time_s[:, None, None]
        both = analysis.ours.scored & perfect.scored & analysis.clairvoyant.scored
        parts = {"all": both}
        if name.startswith("partition"):
            apart = analysis.ours.cut_off.any(axis=0)
            parts["inside"] = both & (time_s >= CUT_S) & (time_s < HEALED_S)
            parts["healed"] = both & apart & (time_s >= AGAIN_S)
        if name.startswith("killed"):
            others = np.arange(both.shape[1]) != KILLED - 1
            parts["others"] = both & others[:, None] & others
        courses = {OURS: analysis.ours, PERFECT: perfect, TWIN: analysis.clairvoyant}
        found[name] = {
            "squares": {
                part: {whose: _squares(course.relative.position_m[mask]) for whose, course in courses.items()}
                for part, mask in parts.items()
            },
            "rmse_m": said["relative"]["rmse_m"],
            "naive_m": said["naive"]["relative"]["rmse_m"],
            "anees": said["anees"],
            "wrong": sum(mav["wrong_commits"] for mav in said["mavs"]),
            "all_localised": all(mav["state"] == "localised" for mav in said["mavs"]),
            "across": said["across_cuts"],
            "late_starts": [dict(each) for each in said["late_starts"]],
        }
    return found


def _squares(error_m: np.ndarray) -> tuple[float, int]:
    known = error_m[np.isfinite(error_m)]
    return float((known**2).sum()), len(known)


def ratio(runs: list[dict[str, Any]], part: str, to: str) -> float:
    """RMSE over all runs, ours against another's."""

    def rms(whose: str) -> float:
        squares, counts = zip(*(run["squares"][part][whose] for run in runs), strict=True)
        return math.sqrt(sum(squares) / sum(counts))

    return rms(OURS) / rms(to)


def line(name: str, runs: list[dict[str, Any]]) -> str:
    notes = [f"{part}: {ratio(runs, part, PERFECT):.2f} x perfect" for part in runs[0]["squares"] if part != "all"]
    if runs[0]["across"]:
        across = {who: np.mean([run["across"][who]["rmse_m"] for run in runs]) for who in ("ours", "naive")}
        notes.append(f"across: {across['ours']:.3f} m, reckoned from the cut {across['naive']:.3f} m")
    for what, words in (("localised_others_after_s", "knows all"), ("localised_by_others_after_s", "known by all")):
        waits = [math.inf if start[what] is None else start[what] for run in runs for start in run["late_starts"]]
        if waits:
            notes.append(f"{words} after at most {max(waits):.1f} s")
    if name.startswith("own"):
        notes.append(
            f"{np.mean([r['rmse_m'] for r in runs]):.3f} m, naive {np.mean([r['naive_m'] for r in runs]):.3f} m"
        )
    localised = sum(run["all_localised"] for run in runs)
    return (
        f"| {name} | {len(runs)} | {ratio(runs, 'all', PERFECT):.2f} | {ratio(runs, 'all', TWIN):.3f}"
        f" | {np.mean([run['anees'] for run in runs]):.2f} | {sum(run['wrong'] for run in runs)}"
        f" | {localised} of {len(runs)} | {'; '.join(notes)} |"
    )


def main(seeds: str) -> int:
    first, last = map(int, seeds.split(":"))
    flown = []
    with ProcessPoolExecutor(int(os.environ.get("JOBS", os.cpu_count() or 1))) as pool:
        for flight in as_completed([pool.submit(fly, seed) for seed in range(first, last)]):
            flown.append(flight.result())
            print(f"\r{len(flown)} of {last - first} seeds", end="", flush=True)
    lines = [
        "| fault | seeds | x perfect | x told twin | ANEES | wrong commits | all localised at the end | |",
        "|---|---|---|---|---|---|---|---|",
        *(line(name, [each[name] for each in flown]) for name in ROWS),
    ]
    Path("runs").mkdir(exist_ok=True)
    Path("runs/networks.json").write_text(json.dumps(flown) + "\n")
    Path("runs/networks.md").write_text("\n".join(lines) + "\n")
    print("", *lines, sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else "0:10"))
