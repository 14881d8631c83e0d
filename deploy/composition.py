"""How does everything fit into one process? The composition root: the only module that knows all three programs.

It checks an experiment with the parsers of those who will read it, and flies world and agents over one bus in memory.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from agent.config import AgentConfig
from agent.config import parse as parse_agent
from agent.interface.bus import MemoryBus, Packet
from agent.interface.tables import BadExperiment
from deploy.experiment import Experiment

if TYPE_CHECKING:
    from world.config import WorldConfig

ROUNDS = 10  # of asking every agent; two are enough: one to share, one to estimate


class Checked(NamedTuple):
    world: "WorldConfig"
    agent: AgentConfig


def check(experiment: Experiment, in_process: bool) -> Checked:
    """Reads both tables as the programs will.

    Raises:
        BadExperiment: unknown key, wrong type or impossible value; real time in one process.
    """
    from world.config import parse as parse_world

    if in_process and experiment.fleet.realtime:
        raise BadExperiment("fleet.realtime = true: in one process there is no real time, expected false")
    return Checked(parse_world(experiment.world, experiment.fleet), parse_agent(experiment.agent))


def fly(experiment: Experiment, epoch: int, record: Callable[[list[Packet]], None]) -> None:
    """The whole run in this process, in lockstep; `record` is given every message, tick by tick.

    Raises:
        BadExperiment: as `check` does.
    """
    from agent.agent import Agent
    from world.world import World

    fleet = experiment.fleet
    configs = check(experiment, in_process=True)
    bus = MemoryBus()
    everything = bus.subscribe("**")
    world = World(configs.world, fleet, epoch, bus.another())
    agents = [Agent(configs.agent, fleet, mav, epoch, bus.another()) for mav in fleet.ids]
    world.begin()
    while not world.finished:
        world.publish_tick()
        for _ in range(ROUNDS):
            for agent in agents:
                agent.advance()
            if world.answered():
                break
        else:
            raise RuntimeError("an agent does not answer, although it has been given everything")
        world.step()
        record(everything.drain())
    world.end()
    for agent in agents:
        agent.advance()
    record(everything.drain())
