"""Do a thousand random fault schedules break anything? `make schedules` (or `SEEDS=0:100`)

Each is flown in one process, with what `tests/schedules.py` expects looked at after everything that an agent does. Exit
status 1 if a run broke; which, and how, is in runs/schedules.json: `tests.schedules.drawn(seed)` is it again.
"""

import json
import logging
import os
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported

from tests import schedules


def broken(seed: int) -> str | None:
    logging.disable(logging.WARNING)
    try:
        schedules.fly(schedules.drawn(seed))
    except Exception as error:  # whatever it is, it should not have been
        return f"{type(error).__name__}: {error}"
    return None


def main(seeds: str) -> int:
    first, last = map(int, seeds.split(":"))
    found: dict[int, str] = {}
    with ProcessPoolExecutor() as pool:
        flights = {pool.submit(broken, seed): seed for seed in range(first, last)}
        for count, flight in enumerate(as_completed(flights), 1):
            how = flight.result()
            if how is not None:
                found[flights[flight]] = how
                print(f"\rseed {flights[flight]}: {how}")
            print(f"\r{count} of {len(flights)} schedules, {len(found)} broken", end="", flush=True)
    print()
    Path("runs").mkdir(exist_ok=True)
    Path("runs/schedules.json").write_text(json.dumps({"seeds": seeds, "broken": found}, indent=2) + "\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else "0:1000"))
