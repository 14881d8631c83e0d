"""How do messages travel between processes? The bus over Zenoh. The only module that imports zenoh."""

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import zenoh

from agent.interface import clock, topics
from agent.interface.bus import CAPACITY, POLL_S, BusError, Packet
from agent.interface.messages import MAX_BYTES, Rejected

LEASE_S = 2.0  # real time: after so much silence a frozen or cut-off process counts as gone ...
LOSSLESS_LEASE_S = 86_400.0  # ... in lockstep it is waited for


class Token(NamedTuple):
    """A sign of life that has appeared, or is gone."""

    key: str
    present: bool


@dataclass(frozen=True)
class Network:
    """One process's place in the mesh."""

    name: str  # "world", "mav_3", "recorder"
    namespace: str  # prefixes every key; two runs with different ones never hear each other
    listen: tuple[str, ...] = ()  # Zenoh endpoints
    connect: tuple[str, ...] = ()
    lossless: bool = True
    deny: tuple[str, ...] = ()  # key expressions (without the namespace) that this process may not receive


class ZenohBus:
    """A peer session with explicit endpoints; leave it by `with`, so that it closes on every way out."""

    def __init__(self, network: Network) -> None:
        self.network = network
        try:
            self._session = zenoh.open(_config(network))
        except zenoh.ZError as error:
            raise BusError(f"{network.name}: cannot open the network: {_said(error)}") from None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._alive: dict[str, zenoh.LivelinessToken] = {}

    def publish(self, key: str, payload: bytes) -> None:
        publisher = self._publishers.get(key)
        if publisher is None:
            lossless = self.network.lossless or not _may_be_lost(key)
            publisher = self._publishers[key] = self._session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP,
                reliability=zenoh.Reliability.RELIABLE if lossless else zenoh.Reliability.BEST_EFFORT,
            )
        publisher.put(payload)

    def subscribe(self, pattern: str, capacity: int = CAPACITY) -> "ZenohInbox":
        handlers = zenoh.handlers
        handler: Any = handlers.FifoChannel(CAPACITY) if self.network.lossless else handlers.RingChannel(capacity)
        return ZenohInbox(self._session.declare_subscriber(pattern, handler, allowed_origin=zenoh.Locality.REMOTE))

    def announce(self, key: str) -> None:
        """Declares a liveliness token: it vanishes with this process, however it ends."""
        if key not in self._alive:
            self._alive[key] = self._session.liveliness().declare_token(key)

    def withdraw(self, key: str) -> None:
        """Takes back what was announced, if it was."""
        token = self._alive.pop(key, None)
        if token is not None:
            token.undeclare()  # type: ignore[no-untyped-call]

    def tokens(self, pattern: str) -> "ZenohTokens":
        """Those of other processes (and of this one) at keys that match: which there are, and then every change."""
        handler: Any = zenoh.handlers.FifoChannel(CAPACITY)
        return ZenohTokens(self._session.liveliness().declare_subscriber(pattern, handler, history=True))

    def present(self, pattern: str, timeout_s: float) -> list[Token]:
        """The tokens that every process with a link to this one knows of, at this moment."""
        replies = self._session.liveliness().get(pattern, zenoh.handlers.FifoChannel(CAPACITY), timeout=timeout_s)
        return [Token(str(reply.ok.key_expr), True) for reply in replies if reply.ok is not None]

    def await_alive(self, keys: Iterable[str], timeout_s: float) -> None:
        """Returns when a token is seen at each of the keys.

        Raises:
            BusError: some did not come in time; it names them.
        """
        missing, deadline = set(keys), clock.now_s() + timeout_s
        with self.tokens("**") as tokens:
            while missing := missing - {token.key for token in tokens.drain() if token.present}:
                if clock.now_s() > deadline:
                    raise BusError(f"{self.network.name}: waited {timeout_s:g} s in vain for {sorted(missing)}")
                clock.sleep_until(clock.now_s() + 0.01)

    def close(self) -> None:
        """
        Raises:
            BusError: somebody did not take what was sent to it.
        """
        try:
            self._session.close()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            words = f"{self.network.name}: cannot leave the network, somebody does not take what was sent"
            raise BusError(f"{words}: {_said(error)}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except BusError:
            if kind is None:  # else it is what came first that counts
                raise


class ZenohInbox:
    def __init__(self, subscriber: "zenoh.Subscriber[Any]") -> None:
        self._subscriber = subscriber

    def drain(self) -> list[Packet]:
        packets: list[Packet] = []
        # At most one capacity: a peer that floods must not keep the loop here.
        while len(packets) < CAPACITY and (sample := self._subscriber.try_recv()) is not None:
            packets.append(Packet(str(sample.key_expr), sample.payload.to_bytes()))
        return packets

    def wait(self, timeout_s: float | None) -> list[Packet]:
        if timeout_s is None:
            sample = self._subscriber.recv()  # signals are handled in here
            return [Packet(str(sample.key_expr), sample.payload.to_bytes()), *self.drain()]
        deadline = clock.now_s() + timeout_s
        while not (packets := self.drain()) and clock.now_s() < deadline:
            clock.sleep_until(clock.now_s() + POLL_S)
        return packets


class ZenohTokens:
    """Leave it by `with`, or keep it as long as the bus."""

    def __init__(self, subscriber: "zenoh.Subscriber[Any]") -> None:
        self._subscriber = subscriber

    def drain(self) -> list[Token]:
        """What has changed since the last look, oldest first."""
        samples = iter(self._subscriber.try_recv, None)
        return [Token(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT) for sample in samples]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]


def _said(error: zenoh.ZError) -> str:
    """Without where in Zenoh's source it says so."""
    return re.sub(r" at \S+\.rs:\d+\.", "", str(error))


def _may_be_lost(key: str) -> bool:
    try:
        return topics.parse(key)[0].may_be_lost
    except Rejected:
        return True


def _config(network: Network) -> zenoh.Config:
    """Explicit endpoints, no discovery, quick retries, bounded messages, no shared memory."""
    lease_s = LOSSLESS_LEASE_S if network.lossless else LEASE_S
    # Over UDP a lost handshake is not repeated, but given up after this time, and then tried again.
    open_ms = 1000 if any(each.startswith("udp/") for each in (*network.listen, *network.connect)) else 2000
    settings: dict[str, Any] = {
        "mode": "peer",
        "namespace": network.namespace,
        "listen": {"endpoints": network.listen},
        "connect": {
            "endpoints": network.connect,
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
        },
        "open": {"return_conditions": {"connect_scouted": False}},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "unicast": {"open_timeout": open_ms, "accept_timeout": open_ms},
            "link": {
                "tx": {"lease": round(1000 * lease_s), "keep_alive": 4, "queue": {"size": {"data": 16}}},
                "rx": {"max_message_size": 2 * MAX_BYTES},
            },
        },
        "adminspace": {"enabled": False},
    }
    if network.deny:
        keys = [f"{network.namespace}/{pattern}" for pattern in network.deny]
        # What comes in is stopped, and that this process would like to have it is not told, so that it is not sent.
        stopped = (("put", "ingress"), ("declare_subscriber", "egress"))
        rules = [
            {"id": message, "permission": "deny", "flows": [flow], "messages": [message], "key_exprs": keys}
            for message, flow in stopped
        ]
        settings["access_control"] = {
            "enabled": True,
            "default_permission": "allow",
            "rules": rules,
            "subjects": [{"id": "anyone"}],
            "policies": [{"rules": [rule["id"] for rule in rules], "subjects": ["anyone"]}],
        }
    return zenoh.Config.from_json5(json.dumps(settings))
