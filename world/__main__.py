"""`python -m world`: simulates one run, or plays recorded flights, for the agents on the bus."""

import sys
from functools import partial

from agent.interface import process
from agent.interface.bus import BusError
from agent.interface.tables import BadExperiment
from world.config import parse
from world.roll_call import RollCall, standard_input
from world.world import World


def main() -> int:
    process.stop_on_signals()
    try:
        start = process.arguments("python -m world")
        config = parse(start.experiment.get("world", {}), start.fleet)
        with process.on_the_bus(start) as bus:
            world = World(config, start.fleet, start.epoch, bus)  # subscribes, so it comes before the others are met
            process.join(start, bus)
            roll_call = RollCall(world, standard_input(), partial(process.meet_agents, bus, start.epoch))
            if start.fleet.realtime:
                world.run_realtime(roll_call.realtime)
            else:
                world.run_lockstep(roll_call.lockstep)
    except BadExperiment as error:
        print(f"world: {error}", file=sys.stderr)
        return 2
    except BusError as error:  # it begins with the name of this process
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
