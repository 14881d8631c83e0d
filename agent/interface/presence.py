"""Who is here, and does somebody else claim to be me? Liveliness tokens, and what a process makes of those of others.

A process announces `alive/<name>/<epoch>/<incarnation>/<stage>`: "here" once it listens, "linked" once it has met the
others. Peers do not pass on one another's tokens, so two processes with one name, which have no link to each other,
would not notice: agents also announce whom they see, as `seen/<witness>/<name>/<epoch>/<incarnation>/<stage>`.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

from agent.interface import clock
from agent.interface.bus import BusError
from agent.interface.zenoh_bus import LEASE_S, Network, Token, ZenohBus

HERE, LINKED = "here", "linked"
GRACE_S = LEASE_S + 0.5  # the tokens of a process that was killed or cut off may be seen so long
RANDOM = range(2**20, 2**40)  # incarnations of processes that nobody counts
ASK_S = 1.0


class Claim(NamedTuple):
    """A process that goes by some name. Who restarts it numbers its incarnations; nobody: it is drawn from RANDOM."""

    name: str
    epoch: int
    incarnation: int

    def key(self, stage: str) -> str:
        return f"alive/{self.name}/{self.epoch}/{self.incarnation}/{stage}"


class AlreadyHere(BusError):
    """Another process has this name, and was there first."""


@dataclass
class _Rival:
    """Another process with my name, and who says so at which stage."""

    since_s: float
    seen_by: dict[str, set[str]] = field(default_factory=lambda: {HERE: set(), LINKED: set()})


class Presence:
    """The tokens of one process. Call `look` now and then; it raises when somebody else has the better claim."""

    def __init__(self, bus: ZenohBus, epoch: int, incarnation: int = 0, witness: bool = False) -> None:
        """
        Args:
            witness: whether it tells others whom it sees; then `look` must be called as long as it lives.
        """
        self.claim = Claim(bus.network.name, epoch, incarnation)
        self._bus, self._witness, self._stage = bus, witness, ""
        self._stages: dict[str, set[tuple[int, str]]] = {}  # by name: incarnations and their stages
        self._rivals: dict[int, _Rival] = {}  # by incarnation
        self._tokens = [bus.tokens("alive/**"), bus.tokens(f"seen/*/{self.claim.name}/**")]

    def announce(self, stage: str) -> None:
        self._bus.announce(self.claim.key(stage))
        self._stage = stage

    def look(self) -> None:
        """Takes in who has come and gone.

        Raises:
            AlreadyHere: this process has to give way.
        """
        for tokens in self._tokens:
            for token in tokens.drain():
                self._take(token)
        self._give_way()

    def ask(self) -> None:
        """The same, but asks the others, so that nothing is missed that is known to them by now."""
        for pattern in ("alive/**", f"seen/*/{self.claim.name}/**"):
            for token in self._bus.present(pattern, ASK_S):
                self._take(token)
        self.look()

    def has(self, name: str, stage: str = LINKED) -> bool:
        """Whether a process of this name has come so far."""
        return any(known == stage for _, known in self._stages.get(name, ()))

    def has_mav(self, mav: int) -> bool:
        return self.has(f"mav_{mav}")

    @property
    def contested(self) -> bool:
        """Whether somebody else seems to have the better claim; `look` will raise if that does not pass."""
        return any(self._outranks(incarnation, rival) for incarnation, rival in self._rivals.items())

    def _take(self, token: Token) -> None:
        kind, *chunks = token.key.split("/")
        witness = chunks.pop(0) if kind == "seen" else "this process"
        if len(chunks) != 4 or not (chunks[2].isascii() and chunks[2].isdecimal()):
            return
        name, epoch, incarnation, stage = chunks[0], chunks[1], int(chunks[2]), chunks[3]
        if epoch != str(self.claim.epoch) or stage not in (HERE, LINKED):
            return
        if name != self.claim.name:
            self._take_other(name, incarnation, stage, token)
        elif incarnation != self.claim.incarnation:
            rival = self._rivals.setdefault(incarnation, _Rival(clock.now_s()))
            (rival.seen_by[stage].add if token.present else rival.seen_by[stage].discard)(witness)
            if not any(rival.seen_by.values()):
                del self._rivals[incarnation]

    def _take_other(self, name: str, incarnation: int, stage: str, token: Token) -> None:
        known = self._stages.setdefault(name, set())
        (known.add if token.present else known.discard)((incarnation, stage))
        if self._witness:
            seen = f"seen/{self.claim.name}/{token.key.removeprefix('alive/')}"
            (self._bus.announce if token.present else self._bus.withdraw)(seen)

    def _outranks(self, incarnation: int, rival: _Rival) -> bool:
        """Who was restarted replaces those before it. Else who has met the others was first, and of two who have, or
        have not, it is the lower number."""
        if max(incarnation, self.claim.incarnation) < RANDOM.start:
            return incarnation > self.claim.incarnation
        if bool(rival.seen_by[LINKED]) != (self._stage == LINKED):
            return bool(rival.seen_by[LINKED])
        return incarnation < self.claim.incarnation

    def _give_way(self) -> None:
        for incarnation, rival in self._rivals.items():
            if self._outranks(incarnation, rival) and clock.now_s() - rival.since_s > GRACE_S:
                by = ", ".join(sorted(set().union(*rival.seen_by.values())))
                raise AlreadyHere(f"{in_words(self.claim.name)} (incarnation {incarnation}, seen by {by})")


def in_words(name: str) -> str:
    return (
        f"MAV {name.removeprefix('mav_')} is already flying" if name.startswith("mav_") else f"{name} is already here"
    )


def occupant(network: Network) -> str | None:
    """Who listens at the endpoints at which this process wants to: None if that is not a process of this name."""
    with ZenohBus(replace(network, listen=(), connect=network.listen)) as bus:
        deadline = clock.now_s() + ASK_S
        while clock.now_s() < deadline:
            if bus.present(f"alive/{network.name}/**", ASK_S):
                return in_words(network.name)
            clock.sleep_until(clock.now_s() + 0.02)
    return None


def meet(presence: Presence, others: tuple[str, ...], timeout_s: float) -> None:
    """Returns when these processes and this one have links to one another; declare subscriptions before.

    A token is visible over a link only after the subscriptions declared before it, so nothing that is published
    afterwards can be lost for want of a subscriber.

    Raises:
        AlreadyHere: somebody else has the same name.
        BusError: some process did not come in time.
    """
    deadline = clock.now_s() + timeout_s
    for stage in (HERE, LINKED):
        presence.announce(stage)
        asked = False
        while True:
            presence.look()
            missing = [name for name in others if not presence.has(name, stage)]
            if not missing and not asked:
                presence.ask()
                asked = True
            if not missing and not presence.contested:
                break
            if missing and clock.now_s() > deadline:
                raise BusError(f"{presence.claim.name}: waited {timeout_s:g} s in vain for {', '.join(missing)}")
            clock.sleep_until(clock.now_s() + 0.01)
