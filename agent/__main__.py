"""`python -m agent`: one MAV as a process."""

import logging
import sys
from collections.abc import Callable

from agent import config
from agent.agent import Agent
from agent.interface import process
from agent.interface.bus import Bus, BusError
from agent.interface.process import Start
from agent.interface.tables import BadExperiment
from agent.interface.zenoh_bus import ZenohBus


def main(wrapped: Callable[[ZenohBus, Start], Bus] = lambda bus, _: bus) -> int:
    """Flies one MAV; `wrapped` gives the bus that it uses, from its own."""
    process.stop_on_signals()
    try:
        start = process.arguments("agent")
        chosen = config.parse(start.experiment["agent"], start.fleet)
    except BadExperiment as error:
        print(f"agent: {error}", file=sys.stderr)
        return 2
    try:
        with process.on_the_bus(start) as bus:
            agent = Agent(chosen, start.fleet, start.mav, start.epoch, wrapped(bus, start))
            agent.run(process.join(start, bus, witness=True))
    except BusError as error:
        logging.getLogger("agent").error("%s", error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
