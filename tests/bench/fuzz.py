"""What do 100,000 fuzzed messages do to an agent of seven MAVs, and what does a tick cost among them? `make fuzz`

One agent hears six peers, once undisturbed and once among messages that break the rules (`tests/hostile.py`), fifty
per tick. Both flights take turns, tick by tick, so that whatever else the machine does slows both. Its estimates must
be the same to the last bit, and the median tick must not take longer by more than a tenth. Exit status 1 if that does
not hold.
"""

import json
import logging
import os
import statistics
import sys
from itertools import chain
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported

from agent.interface import clock, topics
from agent.interface.bus import Packet
from tests.agent.test_agent import EPOCH, Rig
from tests.hostile import Enemy

MAVS, TICKS, MESSAGES = 7, 2000, 100_000
SLOWER = 1.1


class Flight:
    """The first agent of a team, which hears the others."""

    def __init__(self) -> None:
        self._rig = Rig(mavs=MAVS, ticks=TICKS)
        (self._agent,) = self._rig.agents = self._rig.agents[:1]
        self.estimates: list[Packet] = []
        self.tick_us: list[int] = []  # everything that the agent does in a tick, reading included
        self._rig.survey()

    def tick(self, k: int, attack: list[Packet]) -> None:
        """Before anything else it hears the attack."""
        rig = self._rig
        rig.k = k
        for packet in attack:
            rig.bus.publish(*packet)
        rig.sensors(of=[1])
        rig.shared(of=range(2, MAVS + 1), sets_of_tick=k)
        began_us = clock.now_us()
        self._agent.advance()
        self.tick_us.append(clock.now_us() - began_us)
        self.estimates += [packet for packet in rig.out.drain() if packet.key == topics.key(topics.ESTIMATE, 1)]

    @property
    def rejected(self) -> int:
        return self._agent._inbox.rejected + self._agent._neighbours.unbelieved


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
    clean, dirty = Flight(), Flight()
    for k, attack in enumerate(prepared):
        clean.tick(k, [])
        dirty.tick(k, attack)
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
