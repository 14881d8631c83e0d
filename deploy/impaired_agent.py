"""`python -m deploy.impaired_agent`: the ordinary `python -m agent`, on a network with the experiment's faults."""

import sys
from functools import partial

from agent.__main__ import main
from agent.interface.bus import Bus
from agent.interface.presence import RANDOM
from agent.interface.process import Start, meet_agents
from agent.interface.zenoh_bus import ZenohBus
from deploy import faults
from deploy.impaired_bus import ImpairedBus


def impaired(bus: ZenohBus, start: Start) -> Bus:
    """The bus with the faults on the links to this MAV."""
    table = faults.parse(start.experiment.get("faults", {}), start.fleet)
    meet = partial(meet_agents, bus, start.epoch)
    restarts = 0 if start.incarnation in RANDOM else start.incarnation  # nobody counts those started by hand
    return ImpairedBus(bus, table, start.fleet, start.mav, start.epoch, restarts, meet)


if __name__ == "__main__":
    sys.exit(main(impaired))
