"""What goes wrong in a run, when and between whom? The experiment's [faults] table.

Times are simulated. What is said at the top level holds for every directed link and the whole run; `links` adds to it.
Every fault is a stage of its own: losses are independent of one another, delays add up.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import msgspec

from agent.interface.fleet import Fleet
from agent.interface.tables import BadExperiment, parse_table

LONGEST_S = 60.0  # of any one delay
LONGEST_RUN_S = 86400.0

TopicName = Literal["odometry", "detections"]
Verb = Literal["kill", "stop", "continue", "restart", "join"]

# What each does to a process, from which state to which.
VERBS: dict[str, tuple[tuple[str, ...], str]] = {
    "kill": (("running", "stopped"), "killed"),
    "stop": (("running",), "stopped"),
    "continue": (("stopped",), "running"),
    "restart": (("killed",), "running"),
    "join": (("not yet started",), "running"),
}


class Conditions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True, kw_only=True):
    """What a directed link does to the packets sent over it."""

    loss: float = 0.0  # share lost, each packet for itself
    burst_loss: float = 0.0  # share lost in bursts (Gilbert-Elliott: all while the link is down, none while it is up)
    burst_s: float = 1.0  # mean length of a burst
    delay_ms: float = 0.0
    jitter_ms: float = 0.0  # uniform: up to so much more or less; lognormal: a mean of so much more, with a long tail
    jitter: Literal["uniform", "lognormal"] = "uniform"
    duplicates: float = 0.0  # share that arrives twice, the copy with jitter of its own
    reorder: float = 0.0  # share held back by one to two ticks, so that later ones overtake it
    bandwidth_bytes_s: float = math.inf  # packets queue for it; one that would have to wait for over a second is lost
    topics: tuple[TopicName, ...] = ("odometry", "detections")  # which packets this is about

    def __post_init__(self) -> None:
        for name in ("loss", "burst_loss", "duplicates", "reorder"):
            _require(name, getattr(self, name), 0 <= getattr(self, name) <= 1, "a share, 0 to 1")
        _require("burst_s", self.burst_s, 0.001 <= self.burst_s <= 3600, "0.001 to 3600 s")
        for name in ("delay_ms", "jitter_ms"):
            value = getattr(self, name)
            _require(name, value, 0 <= value <= 1000 * LONGEST_S, f"0 to {1000 * LONGEST_S:g} ms")
        _require("bandwidth_bytes_s", self.bandwidth_bytes_s, self.bandwidth_bytes_s >= 1, "1 or more bytes/s")
        _require("topics", list(self.topics), len(set(self.topics)) == len(self.topics) > 0, "one or both, once each")

    @property
    def disturbs(self) -> bool:
        """Whether a packet can be anything but punctual."""
        return (
            max(self.loss, self.burst_loss, self.delay_ms, self.jitter_ms, self.duplicates, self.reorder) > 0
            or self.bandwidth_bytes_s < math.inf
        )


class LinkRule(Conditions, frozen=True, forbid_unknown_fields=True, omit_defaults=True, kw_only=True):
    """The same for some links and some time."""

    senders: tuple[int, ...] = ()  # MAVs; none named: all
    receivers: tuple[int, ...] = ()
    from_s: float = 0.0  # packets sent from here on ...
    until_s: float = math.inf  # ... and before this

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_span(self.from_s, self.until_s)

    def holds(self, sender: int, receiver: int) -> bool:
        return sender in (self.senders or (sender,)) and receiver in (self.receivers or (receiver,))


class Partition(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True, kw_only=True):
    """No packet passes from one group to another; a MAV in none of them hears and is heard by all."""

    groups: tuple[tuple[int, ...], ...]
    from_s: float = 0.0
    until_s: float = math.inf  # it heals
    one_way: bool = False  # only what a group sends to those after it in the list is lost; the other way all passes
    kept: bool = False  # what was sent meanwhile is not lost, but all arrives when it heals, as over TCP

    def __post_init__(self) -> None:
        named = [mav for group in self.groups for mav in group]
        sound = len(self.groups) > 1 and all(self.groups) and len(set(named)) == len(named)
        _require(
            "groups", [list(group) for group in self.groups], sound, "two groups or more, every MAV in one of them"
        )
        _require_span(self.from_s, self.until_s)

    def cuts(self, sender: int, receiver: int) -> bool:
        """Whether what this sender sends does not reach this receiver while it lasts."""
        place = {mav: number for number, group in enumerate(self.groups) for mav in group}
        if sender not in place or receiver not in place or place[sender] == place[receiver]:
            return False
        return not self.one_way or place[sender] < place[receiver]


class ProcessFault(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What happens to the process of one MAV: SIGKILL, SIGSTOP, SIGCONT, started again, or started only now."""

    mav: int
    do: Verb
    at_s: float

    def __post_init__(self) -> None:
        _require("at_s", self.at_s, 0 <= self.at_s <= LONGEST_RUN_S, f"0 to {LONGEST_RUN_S:g} s")

    def tick(self, fleet: Fleet) -> int:
        """Before which tick it happens: the first at or after its time."""
        return math.ceil(self.at_s * fleet.rate_hz - 1e-6)


class Faults(Conditions, frozen=True, forbid_unknown_fields=True, omit_defaults=True, kw_only=True):
    links: tuple[LinkRule, ...] = ()
    partitions: tuple[Partition, ...] = ()
    processes: tuple[ProcessFault, ...] = ()

    @property
    def on_links(self) -> bool:
        return self.disturbs or bool(self.partitions) or any(rule.disturbs for rule in self.links)

    @property
    def present(self) -> bool:
        """Whether there are any: then the agents' buses are wrapped."""
        return self.on_links or bool(self.processes)

    @property
    def late(self) -> tuple[int, ...]:
        """MAVs that are not there at the start."""
        return tuple(fault.mav for fault in self.processes if fault.do == "join")

    def rules(self) -> tuple[LinkRule, ...]:
        """The top level, as a rule for all links and the whole run, and then the links'."""
        shared = {name: getattr(self, name) for name in Conditions.__struct_fields__}
        return (LinkRule(**shared), *self.links)

    def due(self, tick: int, fleet: Fleet) -> list[ProcessFault]:
        """What happens to processes before this tick, by MAV number."""
        return sorted((f for f in self.processes if f.tick(fleet) == tick), key=lambda fault: fault.mav)


def parse(table: dict[str, Any], fleet: Fleet) -> Faults:
    """The [faults] table of an experiment with this fleet.

    Raises:
        BadExperiment: unknown key, wrong type, impossible value, a MAV that is not there, or a sequence of process
            faults that makes no sense.
    """
    faults = parse_table(Faults, table, "faults")
    for n, rule in enumerate(faults.links):
        _known(f"faults.links[{n}].senders", rule.senders, fleet)
        _known(f"faults.links[{n}].receivers", rule.receivers, fleet)
        if rule.senders and rule.receivers and len({*rule.senders, *rule.receivers}) == 1:
            raise BadExperiment(
                f"faults.links[{n}].receivers = {list(rule.receivers)}: expected others than the sender itself"
            )
        _begins(f"faults.links[{n}]", rule.from_s, fleet)
    for n, partition in enumerate(faults.partitions):
        _begins(f"faults.partitions[{n}]", partition.from_s, fleet)
        for group in partition.groups:
            _known(f"faults.partitions[{n}].groups", group, fleet)
        if partition.kept and partition.until_s > LONGEST_RUN_S:
            raise BadExperiment(
                f"faults.partitions[{n}].kept = True: expected until_s, when what was kept arrives, "
                f"at most {LONGEST_RUN_S:g} s"
            )
    for n, fault in enumerate(faults.processes):
        _known(f"faults.processes[{n}].mav", (fault.mav,), fleet)
        if fault.tick(fleet) >= fleet.ticks:
            raise BadExperiment(
                f"faults.processes[{n}].at_s = {fault.at_s:g}: expected before the last tick, "
                f"at {fleet.stamp_ns(fleet.ticks - 1) / 1e9:g} s"
            )
    for mav in fleet.ids:
        _check_life(mav, faults.processes, fleet)
    return faults


def _check_life(mav: int, faults: Sequence[ProcessFault], fleet: Fleet) -> None:
    """Whether each fault of this MAV finds its process in a state in which it can happen."""
    mine = sorted((fault.tick(fleet), n) for n, fault in enumerate(faults) if fault.mav == mav)
    joins = any(faults[n].do == "join" for _, n in mine)
    state, before = ("not yet started" if joins else "running"), -1
    for tick, n in mine:
        fault = faults[n]
        possible, after = VERBS[fault.do]
        where = f"faults.processes[{n}].do = {fault.do!r} for MAV {mav} at {fault.at_s:g} s"
        if tick == before:
            raise BadExperiment(f"{where}: something happens to it in the same tick already, expected one at a time")
        if state not in possible:
            raise BadExperiment(f"{where}: it is {state} then, expected {' or '.join(possible)}")
        state, before = after, tick


def _known(where: str, mavs: Iterable[int], fleet: Fleet) -> None:
    for mav in mavs:
        if mav not in fleet.ids:
            raise BadExperiment(f"{where}: there is no MAV {mav}, expected 1 to {fleet.mavs}")


def _begins(where: str, from_s: float, fleet: Fleet) -> None:
    if from_s >= fleet.duration_s:
        raise BadExperiment(f"{where}.from_s = {from_s:g}: expected before the run ends, at {fleet.duration_s:g} s")


def _require(name: str, value: object, holds: bool, expected: str) -> None:
    if not holds:
        raise ValueError(f"{name} = {value!r}: expected {expected}")


def _require_span(from_s: float, until_s: float) -> None:
    _require("from_s", from_s, 0 <= from_s <= LONGEST_RUN_S, f"0 to {LONGEST_RUN_S:g} s")
    _require("until_s", until_s, until_s > from_s, f"after from_s = {from_s:g} s")
