"""How does everything fit into one process? The composition root: the only module that knows all three programs.

It checks an experiment with the parsers of those who will read it, and flies world and agents over one bus in memory.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from agent.config import AgentConfig
from agent.config import parse as parse_agent
from agent.interface import messages, topics
from agent.interface.bus import MemoryBus, Packet
from agent.interface.tables import BadExperiment
from deploy.experiment import Experiment
from deploy.faults import ProcessFault
from deploy.impaired_bus import ImpairedBus

if TYPE_CHECKING:
    from agent.agent import Agent
    from world.config import WorldConfig

PATIENCE = 4  # rounds in which nobody says anything: with faults two are usual, one to share and one to be shown


class Checked(NamedTuple):
    world: "WorldConfig"
    agent: AgentConfig


def check(experiment: Experiment, in_process: bool) -> Checked:
    """Reads both tables as the programs will; [fleet] and [faults] have been read already.

    Raises:
        BadExperiment: unknown key, wrong type or impossible value; real time in one process.
    """
    from world.config import parse as parse_world

    if in_process and experiment.fleet.realtime:
        raise BadExperiment("fleet.realtime = true: in one process there is no real time, expected false")
    world, agent = parse_world(experiment.world, experiment.fleet), parse_agent(experiment.agent, experiment.fleet)
    if agent.mission is not None and not world.commanded:
        raise BadExperiment(
            "agent.mission: the MAVs do not fly what their agents command, expected world.commanded = true"
        )
    return Checked(world, agent)


def fly(experiment: Experiment, epoch: int, record: Callable[[list[Packet]], None]) -> None:
    """The whole run in this process, in lockstep; `record` is given every message, tick by tick.

    Raises:
        BadExperiment: as `check` does.
    """
    from world.world import World

    configs = check(experiment, in_process=True)
    bus = MemoryBus()
    everything = bus.subscribe("**")
    world = World(configs.world, experiment.fleet, epoch, bus.another())
    crew = _Crew(configs.agent, experiment, epoch, bus.another())
    world.begin()
    for tick in range(experiment.fleet.ticks):
        if crew.suffer(tick):
            world.set_roll(crew.roll)
        world.publish_tick()
        heard = idle = 0
        while not world.answered():
            crew.advance()
            idle = idle + 1 if len(everything.packets) == heard else 0
            heard = len(everything.packets)
            if idle == PATIENCE:
                raise RuntimeError("an agent does not answer, although it has been given everything")
        world.step()
        record(everything.drain())
    world.end()
    crew.advance()
    record(everything.drain())


class _Member(NamedTuple):
    agent: "Agent"
    bus: MemoryBus
    impaired: ImpairedBus | None  # around the bus; None: there are no faults


class _Crew:
    """The agents, and what befalls their processes."""

    def __init__(self, config: AgentConfig, experiment: Experiment, epoch: int, bus: MemoryBus) -> None:
        self._config, self._fleet, self._faults = config, experiment.fleet, experiment.faults
        self._epoch, self._bus = epoch, bus
        self.roll = {mav: 0 for mav in self._fleet.ids if mav not in self._faults.late}  # who takes part: incarnations
        self._incarnations = dict.fromkeys(self._fleet.ids, 0)
        self._members = {mav: self._started(mav) for mav in self.roll}
        self._entries = 0  # in the journal

    def _started(self, mav: int) -> _Member:
        from agent.agent import Agent

        bus, incarnation = self._bus.another(), self._incarnations[mav]
        if not self._faults.present:
            return _Member(Agent(self._config, self._fleet, mav, self._epoch, bus), bus, None)
        impaired = ImpairedBus(bus, self._faults, self._fleet, mav, self._epoch, incarnation)
        return _Member(Agent(self._config, self._fleet, mav, self._epoch, impaired), bus, impaired)

    def suffer(self, tick: int) -> bool:
        """Carries out the process faults that are due before this tick; says whether the roll is to be called."""
        due = self._faults.due(tick, self._fleet)
        for fault in due:
            self._befall(fault)
            header = (messages.VERSION, self._epoch, messages.DEPLOY, self._entries, self._fleet.stamp_ns(tick))
            self._entries += 1
            entry = messages.encode(messages.ProcessFault(*header, do=fault.do))
            self._bus.publish(topics.key(topics.PROCESS_FAULT, fault.mav), entry)
        return bool(due) or (tick == 0 and bool(self._faults.processes))

    def _befall(self, fault: ProcessFault) -> None:
        mav = fault.mav
        if fault.do in ("kill", "stop"):
            self.roll.pop(mav, None)
            if fault.do == "kill":
                self._members.pop(mav).bus.close()
            return
        if fault.do == "restart":
            self._incarnations[mav] += 1
        if fault.do in ("restart", "join"):
            self._members[mav] = self._started(mav)
        self.roll[mav] = self._incarnations[mav]

    def advance(self) -> None:
        """Lets everybody who is there and not stopped do what can be done now."""
        for mav in sorted(self.roll):
            member = self._members[mav]
            member.agent.advance(all_here=member.impaired is not None and member.impaired.all_shown)
