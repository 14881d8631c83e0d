"""What do 100,000 fuzzed messages do to an agent of seven MAVs, and what does a tick cost among them? `make fuzz`

One agent hears six peers, first undisturbed and then among messages that break the rules (`tests/hostile.py`), fifty
per tick. Its estimates must be the same to the last bit, and the median tick must not
take longer by more than a tenth. Exit status 1 if that does not hold.
"""

import json
import logging
import os
import statistics
import sys
from itertools import chain
from pathlib import Path
from typing import NamedTuple

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported

from agent.interface import clock, topics
from agent.interface.bus import Packet
from tests.agent.test_agent import EPOCH, Rig
from tests.hostile import Enemy

MAVS, TICKS, MESSAGES = 7, 2000, 100_000
SLOWER = 1.1


class Flight(NamedTuple):
    estimates: list[Packet]
    tick_us: list[int]  # everything that the agent does in a tick, reading included
    rejected: int


def fly(attacks: list[list[Packet]]) -> Flight:
    """The first agent of a team hears the others, and before each tick what is in `attacks`."""
    rig = Rig(mavs=MAVS, ticks=TICKS)
    (agent,) = rig.agents = rig.agents[:1]
    estimates, tick_us = [], []
    rig.survey()
    for k in range(TICKS):
        rig.k = k
        for packet in attacks[k] if attacks else ():
            rig.bus.publish(*packet)
        rig.sensors(of=[1])
        rig.shared(of=range(2, MAVS + 1), sets_of_tick=k)
        began_us = clock.now_us()
        agent.advance()
        tick_us.append(clock.now_us() - began_us)
        estimates += [packet for packet in rig.out.drain() if packet.key == topics.key(topics.ESTIMATE, 1)]
    return Flight(estimates, tick_us, agent._inbox.rejected + agent._neighbours.unbelieved)


def attacks() -> list[list[Packet]]:
    """By tick; from real messages, damaged, of other runs and times, in others' names."""
    rig = Rig(mavs=MAVS, ticks=5)
    rig.fly()
    enemy = Enemy(0, MAVS, EPOCH, rig.out.drain())
    return [[enemy.packet(rig.fleet.stamp_ns(max(k - 1, 0))) for _ in range(MESSAGES // TICKS)] for k in range(TICKS)]


def main() -> int:
    logging.disable(logging.WARNING)
    prepared = attacks()
    heard = sum(
        packet.key.startswith(("sensor/1/", "air/")) and packet.key.count("/") == 2 for packet in chain(*prepared)
    )
    clean, dirty = fly([]), fly(prepared)
    slower = statistics.median(dirty.tick_us) / statistics.median(clean.tick_us)
    found = {
        "messages": MESSAGES,
        "heard": heard,
        "rejected": dirty.rejected,  # and the rest are readings of its own sensors, off the common beat
        "same_estimates": clean.estimates == dirty.estimates,
        "tick_ms": [statistics.median(flight.tick_us) / 1000 for flight in (clean, dirty)],
        "slower": slower,
    }
    Path("runs").mkdir(exist_ok=True)
    Path("runs/fuzz.json").write_text(json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))
    fine = found["same_estimates"] and len(clean.estimates) == TICKS and slower <= SLOWER
    return 0 if fine else 1


if __name__ == "__main__":
    sys.exit(main())
