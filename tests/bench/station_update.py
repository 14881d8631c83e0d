"""How long does one station update take, with and without gating and hypothesis evaluation? `make bench`

Both columns work on the same states and the same detection sets, one after the other in one process. The states come
from a filter that has flown for 3 s; the sets are those with as many detections as targets. The plain column
enumerates every hypothesis, in chunks; at N = 9 that takes seconds, so it gets fewer sets. Medians are quoted.
"""

import json
import os
import sys
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported

import numpy as np

from agent.estimator.estimator import Estimator
from agent.estimator.moments import DetectionGeometry
from agent.estimator.station_update import Pairs
from agent.interface.fleet import Fleet
from deploy.paper.cost import CONFIG, Row, Update, measure
from tests import team

SETTLED = 30  # ticks


def updates(mavs: int, formation: str, wanted: int) -> list[Update]:
    """Station updates in flight whose sets hold as many detections as there are targets."""
    rng, found = np.random.default_rng(mavs), []
    estimator = Estimator(CONFIG, Fleet(mavs=mavs), station=1)
    geometry = [DetectionGeometry(mavs + 1, s) for s in range(1, mavs + 1)]
    for k, tick in enumerate(team.PATHS[formation](rng, mavs, 100_000)):
        if k == 0:
            noise = np.column_stack([rng.normal(0, 0.2, (mavs, 3)), rng.normal(0, 0.1, mavs)])
            noise[0] = 0
            estimator.start(team.frames_in(tick.truth, 1) + noise, 0.2, 0.1)
        estimator.predict(tick.odometry)
        for station, spherical in tick.sets.items():
            if k >= SETTLED and len(spherical) == mavs - 1:
                poses = estimator.poses
                pairs = Pairs.at(poses, CONFIG.detector)
                found.append(Update(poses, geometry[station - 1], pairs, spherical))
                if len(found) == wanted:
                    return found
            estimator.associate(station, spherical)
        estimator.finish()
    raise AssertionError("the path has no end")


def main() -> None:
    print("one station update, ms (medians), one core; plain: no gating, every hypothesis\n")
    print(f"{'N':>3} {'formation':>9} {'hypotheses':>12} {'fast':>8} {'plain':>10} {'ratio':>8}")
    rows = []
    for formation in ("circle", "line"):
        for mavs in (*range(3, 10), 12, 20):
            row = measure(mavs, updates(mavs, formation, 150), with_plain=mavs <= 9)
            rows.append((formation, row))
            plain, ratio = (
                ("", "") if row.plain_ms is None else (f"{row.plain_ms:10.2f}", f"{row.plain_ms / row.fast_ms:8.0f}")
            )
            count = f"{row.hypotheses:12d}" if row.plain_ms is not None else f"{row.hypotheses:12.1e}"
            print(f"{row.n:3d} {formation:>9} {count} {row.fast_ms:8.3f} {plain:>10} {ratio:>8}", flush=True)
    exponents = {}
    for formation in ("circle", "line"):
        of = [(row.n, row.fast_ms) for flown, row in rows if flown == formation]
        n, ms = np.log(np.array(of)).T
        exponents[formation] = float(np.polyfit(n, ms, 1)[0])
        print(f"growth of the fast update with N, {formation}: N^{exponents[formation]:.2f}")
    compared = [(flown, row) for flown, row in rows if row.plain_ms is not None]
    result = {
        "station_update": [_entry(row) for flown, row in compared if flown == "circle"],
        "station_update_line": [_entry(row) for flown, row in compared if flown == "line"],
        "fast_only": [{"n": r.n, "formation": at, "fast_ms": r.fast_ms} for at, r in rows if r.plain_ms is None],
        "growth_exponent": exponents,
    }
    path = Path("runs/bench.json")
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(result, indent=1) + "\n")
    print(f"\nwritten to {path}")


def _entry(row: Row) -> dict[str, float]:
    assert row.plain_ms is not None
    return {"n": row.n, "fast_ms": row.fast_ms, "plain_ms": row.plain_ms, "ratio": row.plain_ms / row.fast_ms}


if __name__ == "__main__":
    sys.exit(main())
