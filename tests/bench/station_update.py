"""How long does one station update take, with and without gating and hypothesis evaluation? `make bench`

Both columns work on the same states and the same detection sets, one after the other in one process. The states come
from a filter that has flown for 3 s; the sets are those with as many detections as targets. The plain column
enumerates every hypothesis, in chunks; at N = 9 that takes seconds, so it gets fewer sets. Medians are quoted.
"""

import json
import os
import statistics
import sys
from math import comb, factorial
from pathlib import Path
from typing import NamedTuple

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported

import numpy as np

from agent.config import AgentConfig
from agent.estimator.cpdaf import Rules
from agent.estimator.estimator import Estimator
from agent.estimator.gating import chi_square_quantile
from agent.estimator.moments import DetectionGeometry
from agent.estimator.state import Poses
from agent.estimator.station_update import Pairs, station_update
from agent.interface import clock
from agent.interface.fleet import Fleet
from tests import team

CONFIG = AgentConfig()
FAST = Rules(chi_square_quantile(CONFIG.filter.P_G, 3), True, CONFIG.filter.pruned_mass)
PLAIN = Rules(np.inf, False, 0.0)
SETTLED = 30  # ticks
PLAIN_BUDGET_US = 8_000_000


class Update(NamedTuple):
    poses: Poses
    geometry: DetectionGeometry
    pairs: Pairs
    spherical: np.ndarray


class Row(NamedTuple):
    n: int
    formation: str
    hypotheses: int
    fast_ms: float
    plain_ms: float | None


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


def time_us(update: Update, rules: Rules) -> int:
    began = clock.now_us()
    station_update(*update, CONFIG.detector.clutter_density, rules)
    return clock.now_us() - began


def measure(mavs: int, formation: str, with_plain: bool) -> Row:
    sets = updates(mavs, formation, 150)
    for update in sets[:20]:
        time_us(update, FAST)
    fast = [time_us(update, FAST) for update in sets]
    plain: list[int] = []
    if with_plain:
        time_us(sets[0], PLAIN)  # fills the caches
        for update in sets:
            plain.append(time_us(update, PLAIN))
            if sum(plain) > PLAIN_BUDGET_US and len(plain) >= 3:
                break
    L = mavs - 1
    hypotheses = sum(comb(L, D) ** 2 * factorial(D) for D in range(L + 1))
    return Row(
        mavs,
        formation,
        hypotheses,
        statistics.median(fast) / 1e3,
        statistics.median(plain) / 1e3 if plain else None,
    )


def main() -> None:
    print("one station update, ms (medians), one core; plain: no gating, every hypothesis\n")
    print(f"{'N':>3} {'formation':>9} {'hypotheses':>12} {'fast':>8} {'plain':>10} {'ratio':>8}")
    rows = []
    for formation in ("circle", "line"):
        for mavs in (*range(3, 10), 12, 20):
            row = measure(mavs, formation, with_plain=mavs <= 9)
            rows.append(row)
            plain, ratio = (
                ("", "") if row.plain_ms is None else (f"{row.plain_ms:10.2f}", f"{row.plain_ms / row.fast_ms:8.0f}")
            )
            count = f"{row.hypotheses:12d}" if row.plain_ms is not None else f"{row.hypotheses:12.1e}"
            print(f"{row.n:3d} {formation:>9} {count} {row.fast_ms:8.3f} {plain:>10} {ratio:>8}", flush=True)
    exponents = {}
    for formation in ("circle", "line"):
        of = [(row.n, row.fast_ms) for row in rows if row.formation == formation]
        n, ms = np.log(np.array(of)).T
        exponents[formation] = float(np.polyfit(n, ms, 1)[0])
        print(f"growth of the fast update with N, {formation}: N^{exponents[formation]:.2f}")
    compared = [row for row in rows if row.plain_ms is not None]
    result = {
        "station_update": [_entry(row) for row in compared if row.formation == "circle"],
        "station_update_line": [_entry(row) for row in compared if row.formation == "line"],
        "fast_only": [{"n": r.n, "formation": r.formation, "fast_ms": r.fast_ms} for r in rows if r.plain_ms is None],
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
