"""Which faults does a figure show, in which words? Those of the schedule, and what was done to processes."""

import math
from typing import NamedTuple

from deploy.faults import Conditions, Faults, LinkRule, Partition
from deploy.recording import Recording

DONE = {"kill": "killed", "stop": "stopped", "continue": "goes on", "restart": "started anew", "join": "joins"}


class Span(NamedTuple):
    from_s: float
    until_s: float
    words: str
    cut: bool  # nothing passes


class Mark(NamedTuple):
    at_s: float
    words: str


def on_all_links(faults: Faults) -> str:
    """What holds for all links and the whole run; empty: nothing."""
    return _conditions(faults) if faults.disturbs else ""


def spans(faults: Faults, end_s: float) -> list[Span]:
    """The rules and partitions that hold for some time, or for some links."""
    found = [
        Span(rule.from_s, min(rule.until_s, end_s), _rule(rule), rule.loss >= 1)
        for rule in faults.links
        if rule.disturbs and rule.from_s < end_s
    ]
    found += [
        Span(each.from_s, min(each.until_s, end_s), _partition(each), True)
        for each in faults.partitions
        if each.from_s < end_s
    ]
    return sorted(found)


def marks(recording: Recording) -> list[Mark]:
    """What was done to processes, that of one time together."""
    together: dict[tuple[int, str], list[str]] = {}
    for fault in recording.process_faults:
        together.setdefault((fault.tick, fault.do), []).append(str(fault.mav))
    return [
        Mark(recording.fleet.stamp_ns(tick) / 1e9, f"MAV {', '.join(mavs)} {DONE[do]}")
        for (tick, do), mavs in together.items()
    ]


def _rule(rule: LinkRule) -> str:
    ways = (("from", rule.senders), ("to", rule.receivers))
    where = "".join(f" {way} MAV {', '.join(map(str, mavs))}" for way, mavs in ways if mavs)
    return _conditions(rule) + where


def _partition(partition: Partition) -> str:
    between = " > " if partition.one_way else " | "
    groups = between.join(" ".join(map(str, group)) for group in partition.groups)
    return f"cut {groups}" + (", kept" if partition.kept else "")


def _conditions(each: Conditions) -> str:
    words = []
    if each.loss:
        words.append(f"{100 * each.loss:g} % lost")
    if each.burst_loss:
        words.append(f"{100 * each.burst_loss:g} % lost in bursts of {each.burst_s:g} s")
    if each.delay_ms or each.jitter_ms:
        sign = "±" if each.jitter == "uniform" else "+ log-normal"
        jitter = f" {sign} {each.jitter_ms:g}" if each.jitter_ms else ""
        words.append(f"{each.delay_ms:g}{jitter} ms late")
    if each.duplicates:
        words.append(f"{100 * each.duplicates:g} % twice")
    if each.reorder:
        words.append(f"{100 * each.reorder:g} % overtaken")
    if each.bandwidth_bytes_s < math.inf:
        words.append(f"{each.bandwidth_bytes_s:g} bytes/s")
    return ", ".join(words) + (f" ({each.topics[0]} only)" if len(each.topics) == 1 else "")
