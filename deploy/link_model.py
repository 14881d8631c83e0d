"""What becomes of a packet? Lost, or when it arrives: per directed link, as the [faults] table and the seed say.

Every link has random numbers of its own, and every stage of it too, drawn for each packet whether they are needed or
not. So what one link does depends neither on the others nor on how large a share is lost or a delay is: studies over
such values compare like with like.
"""

import math
from typing import NamedTuple

from agent.interface.fleet import Fleet
from agent.interface.seeds import generator
from deploy.faults import LONGEST_S, Faults, LinkRule

QUEUE_S = 1.0  # a packet that would have to wait longer for its turn is dropped
LOG_SIGMA = 1.0  # of log-normal jitter: one packet in twenty has more than three times the mean


class LinkModel:
    """The link from `sender` to `receiver`. Packets must be given to it in the order in which they were sent."""

    def __init__(self, faults: Faults, fleet: Fleet, sender: int, receiver: int, incarnation: int = 0) -> None:
        """
        Args:
            incarnation: how often the receiver has been started anew; then the random numbers are other ones.
        """
        name = f"link/{sender}-{receiver}" + (f"/{incarnation}" if incarnation else "")
        self._stages = [
            _Stage(rule, fleet, name if n == 0 else f"{name}/rule-{n}")
            for n, rule in enumerate(faults.rules())
            if rule.disturbs and rule.holds(sender, receiver)
        ]
        self._cuts = [each for each in faults.partitions if each.cuts(sender, receiver)]

    def arrivals_ns(self, sent_ns: int, topic: str, size: int) -> tuple[int, ...]:
        """When a packet of so many bytes arrives: never, once, or twice; never before it was sent."""
        effects = [stage.effect(sent_ns, size) for stage in self._stages if stage.concerns(sent_ns, topic)]
        cuts = [each for each in self._cuts if each.from_s <= sent_ns / 1e9 < each.until_s]
        if any(effect is None for effect in effects) or any(not cut.kept for cut in cuts):
            return ()
        known = [effect for effect in effects if effect is not None]
        copies = 2 if any(effect.twice for effect in known) else 1
        healed_ns = max((round(cut.until_s * 1e9) for cut in cuts), default=0)
        return tuple(
            sorted(
                max(healed_ns, sent_ns + max(0, round(1e9 * math.fsum(effect.delays_s[copy] for effect in known))))
                for copy in range(copies)
            )
        )


class _Effect(NamedTuple):
    """What one stage does to a packet that it lets pass."""

    delays_s: tuple[float, float]  # of the packet and of its copy
    twice: bool


class _Stage:
    """One rule on one link."""

    def __init__(self, rule: LinkRule, fleet: Fleet, name: str) -> None:
        self._rule, self._period_s = rule, 1 / fleet.rate_hz
        self._from_ns = round(rule.from_s * 1e9)
        self._until_ns = rule.until_s * 1e9
        self._random = generator(fleet.seed, name)
        self._bursts = _Bursts(rule, fleet.seed, f"{name}/bursts") if rule.burst_loss > 0 else None
        self._free_s = -math.inf  # when the queue for the bandwidth is empty

    def concerns(self, sent_ns: int, topic: str) -> bool:
        return self._from_ns <= sent_ns < self._until_ns and topic in self._rule.topics

    def effect(self, sent_ns: int, size: int) -> _Effect | None:
        """None: lost."""
        rule, sent_s = self._rule, sent_ns / 1e9
        lost, twice, held, copy_held, back, copy_back, jitter, copy_jitter = self._random.random(8).tolist()
        normal, copy_normal = self._random.standard_normal(2).tolist()
        down = self._bursts is not None and self._bursts.down_at(sent_s)
        queued_s = 0.0
        if rule.bandwidth_bytes_s < math.inf:
            begins_s = max(sent_s, self._free_s)
            if begins_s - sent_s > QUEUE_S:
                return None
            self._free_s = begins_s + size / rule.bandwidth_bytes_s
            queued_s = self._free_s - sent_s
        if lost < rule.loss or down:
            return None
        delays_s = tuple(
            queued_s
            + rule.delay_ms / 1000
            + self._jitter_s(uniform, gaussian)
            + (self._period_s * (1 + extent) if share < rule.reorder else 0.0)
            for uniform, gaussian, share, extent in (
                (jitter, normal, held, back),
                (copy_jitter, copy_normal, copy_held, copy_back),
            )
        )
        return _Effect((delays_s[0], delays_s[1]), twice < rule.duplicates)

    def _jitter_s(self, uniform: float, normal: float) -> float:
        extent_s = self._rule.jitter_ms / 1000
        if self._rule.jitter == "uniform":
            return extent_s * (2 * uniform - 1)
        return min(extent_s * math.exp(LOG_SIGMA * normal - LOG_SIGMA**2 / 2), LONGEST_S)


class _Bursts:
    """A link that is up and down in turn, for exponentially distributed times (Gilbert 1960, Elliott 1963)."""

    def __init__(self, rule: LinkRule, seed: int, name: str) -> None:
        self._random = generator(seed, name)
        share = rule.burst_loss
        self._mean_s = {True: rule.burst_s, False: rule.burst_s * (1 - share) / share}  # by whether it is down
        self._down = bool(self._random.random() < share)
        self._changes_s = rule.from_s + self._lasts_s()

    def down_at(self, time_s: float) -> bool:
        """Times must not go back by more than the last change."""
        while time_s >= self._changes_s:
            self._down = not self._down
            self._changes_s += self._lasts_s()
        return self._down

    def _lasts_s(self) -> float:
        return float(self._random.exponential()) * self._mean_s[self._down]


def is_cut(faults: Faults, sender: int, receiver: int, time_s: float) -> bool:
    """Whether nothing at all that is sent at this time reaches the receiver before the fault is over."""
    if any(each.cuts(sender, receiver) and each.from_s <= time_s < each.until_s for each in faults.partitions):
        return True
    deaf: set[str] = set()
    for rule in faults.rules():
        if (
            rule.holds(sender, receiver)
            and rule.from_s <= time_s < rule.until_s
            and max(rule.loss, rule.burst_loss) >= 1
        ):
            deaf |= set(rule.topics)
    return len(deaf) == 2
