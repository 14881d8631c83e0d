"""What is on the wire? Every message of the swarm, its encoding and its validation.

A message is a msgpack array: the header fields first, then its own. Blocks of numbers travel as little-endian
binary (float64 unless said), because a third of a message would otherwise be type bytes. `decode` is the one
boundary: what it returns is of the right version, run, size and shape, finite and within its physical range.
"""

import struct
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from agent.interface.frames import Array
from agent.interface.intent import Intent

VERSION = 1
MAX_BYTES = 65_536  # no message of 50 MAVs is as long
MAX_DETECTIONS = 256
MAX_HYPOTHESES = 16
MAX_REASON = 200  # characters
SEARCHING, AMBIGUOUS, LOCALISED = range(3)
STATES = ("searching", "ambiguous", "localised")
AIR = ("odometry", "detections")  # what MAVs tell each other
Verb = Literal["kill", "stop", "continue", "restart", "join"]  # what can befall a process
DEPLOY = 255  # sender of what deploy itself says
ALIVE, STALE, GONE = range(3)
NEIGHBOURS = ("alive", "stale", "gone")


class Rejected(Exception):
    """A payload that is not a valid message; `reason` is one word for the counters."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


class Header(msgspec.Struct, array_like=True, frozen=True, gc=False, forbid_unknown_fields=True):
    """The fields that every message begins with."""

    version: int
    epoch: int  # the run: messages of another run are ignored
    sender: int  # MAV 1..N; 0 is the world, 255 is deploy
    seq: int  # counts up from 0 per sender and topic
    stamp_ns: int  # time of measurement, ns


class Vio(Header, frozen=True):
    """Visual-inertial odometry: pose of the body in its odometry frame."""

    position: bytes  # (3,) m
    quaternion: bytes  # (4,) x y z w

    def __post_init__(self) -> None:
        _expect_floats("position", self.position, 3, limit=1e6)
        _expect_floats("quaternion", self.quaternion, 4, limit=1.001)
        if abs(sum(q * q for q in struct.unpack("<4d", self.quaternion)) - 1) > 2e-3:
            raise ValueError("not of unit length: quaternion")


class Sightings(Header, frozen=True):
    """One anonymous detection set as the camera gives it, in the (rolled, pitched) body frame."""

    spherical: bytes  # float32 (M, 3): range m, azimuth rad, elevation rad

    def __post_init__(self) -> None:
        _expect_spherical(self.spherical)


class Survey(Header, frozen=True):
    """A rough measurement of where every odometry frame began, in the odometry frame of the receiver."""

    poses: bytes  # (N, 4): x y z m, yaw rad
    position_sigma_m: float  # per axis
    yaw_sigma_rad: float

    def __post_init__(self) -> None:
        _expect_floats("poses", self.poses, None, multiple=4, limit=1e6)
        for name, value in (("position_sigma_m", self.position_sigma_m), ("yaw_sigma_rad", self.yaw_sigma_rad)):
            if not 0 < value < 1e3:
                raise ValueError(f"non-finite or out of range: {name} = {value}")


class Odometry(Header, frozen=True):
    """What peers need of a MAV's odometry: the gravity-aligned pose in its odometry frame."""

    pose: bytes  # (4,): x y z m, yaw rad
    intent: Intent | None = None  # of one that flies a mission: as it was decided in the tick before

    def __post_init__(self) -> None:
        _expect_floats("pose", self.pose, 4, limit=1e6)


class Detections(Header, frozen=True):
    """One anonymous detection set in the gravity-aligned, yaw-only body frame."""

    spherical: bytes  # float32 (M, 3): range m, azimuth rad, elevation rad

    def __post_init__(self) -> None:
        _expect_spherical(self.spherical)


class Estimate(Header, frozen=True):
    """Where the sender believes every MAV to be, in the sender's odometry frame."""

    states: bytes  # uint8 (N,): index into STATES
    poses: bytes  # (N, 4): x y z m, yaw rad
    covariances: bytes  # float32 (N, 10): upper triangle of each pose's 4 x 4 covariance, row by row
    start: bytes  # (4,): where that odometry began, which has moved in its frame as the VIO has drifted
    innovations: int  # of detections associated this tick
    innovations_inside: int  # how many of them lie inside their own 95 % gate

    def __post_init__(self) -> None:
        if any(state >= len(STATES) for state in self.states):
            raise ValueError("states: expected 0, 1 or 2")
        _expect_floats("poses", self.poses, 4 * len(self.states), limit=1e6)
        _expect_floats("covariances", self.covariances, 10 * len(self.states), dtype="<f4", limit=1e12)
        _expect_floats("start", self.start, 4, limit=1e6)


class Registration(Header, frozen=True):
    """Why the sender has not localised everybody, and which joint hypotheses compete: at every tick at which somebody
    is not localised, and once more when everybody is."""

    reasons: tuple[str, ...]  # (N,) why a MAV is not localised, in words; "" for one that is
    weights: bytes  # (K,) of the joint hypotheses, 0 to 1, best first
    placed: bytes  # uint8 (K, N): 1 where a hypothesis says where a MAV is, else 0
    poses: bytes  # float32 (K, N, 4): x y z m, yaw rad in the sender's odometry frame; zeros where not placed

    def __post_init__(self) -> None:
        if not all(len(words) <= MAX_REASON and words.isprintable() for words in self.reasons):
            raise ValueError(f"reasons: expected one line of at most {MAX_REASON} characters each")
        _expect_floats("weights", self.weights, None, limit=1 + 1e-9)
        weights, mavs = floats(self.weights), len(self.reasons)
        if len(weights) > MAX_HYPOTHESES or (weights < 0).any():
            raise ValueError(f"weights: expected at most {MAX_HYPOTHESES}, of 0 to 1")
        if len(self.placed) != len(weights) * mavs or any(place > 1 for place in self.placed):
            raise ValueError(f"placed: {len(self.placed)} bytes, expected {len(weights)} times {mavs}, each 0 or 1")
        _expect_floats("poses", self.poses, 4 * len(self.placed), dtype="<f4", limit=1e6)
        absent = np.frombuffer(self.placed, np.uint8) == 0
        if np.frombuffer(self.poses, "<f4").reshape(-1, 4)[absent].any():
            raise ValueError("poses: expected zeros where not placed")


class Setpoint(Header, frozen=True):
    """What the autopilot is asked to do, in the MAV's odometry frame, at the stamp. Until a newer one comes it
    goes on by its velocity and acceleration, for half a second; then it stays, at rest."""

    position: bytes  # (3,) m
    velocity: bytes  # (3,) m/s
    acceleration: bytes  # (3,) m/s^2
    yaw: float  # rad

    def __post_init__(self) -> None:
        for name in ("position", "velocity", "acceleration"):
            _expect_floats(name, getattr(self, name), 3, limit=1e6)
        if not abs(self.yaw) < 1e3:
            raise ValueError(f"non-finite or out of range: yaw = {self.yaw}")


class Status(Header, frozen=True):
    """How a program is doing: message counters since its start, and what its last tick cost (wall time)."""

    sent: int
    sent_bytes: int
    received: int
    rejected: int
    late: int
    duplicate: int
    tick_us: int
    station_us: tuple[int, ...]  # of each station update; their mean, where several were done at once
    late_ticks: int = 0  # real time only, the world's: published more than half a period late, or not answered in time
    final: bool = False  # the last message of its sender
    neighbours: bytes = b""  # an agent's, uint8 (N,): index into NEIGHBOURS; itself is alive
    holding: bool = False  # an agent's: its own sensors are silent

    def __post_init__(self) -> None:
        if len(self.station_us) > 64:
            raise ValueError("station_us: expected at most 64")
        if any(state >= len(NEIGHBOURS) for state in self.neighbours):
            raise ValueError("neighbours: expected 0, 1 or 2")


class End(Header, frozen=True):
    """The run is over: the stamp is that of the last tick."""


class Roll(Header, frozen=True):
    """Who takes part from the tick of the stamp on, and how often each has been started anew."""

    mavs: bytes  # uint8 (M,): MAV numbers, ascending
    incarnations: tuple[int, ...]  # (M,): 0 for one that has run from the start, or has joined

    def __post_init__(self) -> None:
        if sorted(set(self.mavs)) != list(self.mavs):
            raise ValueError(f"mavs: {list(self.mavs)}, expected ascending numbers")
        if len(self.incarnations) != len(self.mavs) or any(not 0 <= each < 2**31 for each in self.incarnations):
            raise ValueError(f"incarnations: expected {len(self.mavs)} of 0 or more")


class Arrivals(Header, frozen=True):
    """Journal of the faults on the links to one agent: what reached it in the tick of the stamp (for deploy only)."""

    senders: bytes  # uint8 (M,): MAV numbers, in the order of arrival; duplicates included
    topics: bytes  # uint8 (M,): index into AIR
    stamps: bytes  # int64 (M,): when each was measured, ns
    dropped: tuple[int, ...]  # (N,) packets of each MAV that were found lost in this tick

    def __post_init__(self) -> None:
        if not len(self.senders) == len(self.topics) == len(self.stamps) / 8:
            raise ValueError(f"topics, stamps: expected {len(self.senders)} of each")
        if any(topic >= len(AIR) for topic in self.topics) or any(number < 0 for number in self.dropped):
            raise ValueError(f"topics, dropped: expected indices below {len(AIR)}, and counts")


class ProcessFault(Header, frozen=True):
    """Journal of the faults of one agent's process, at the tick of the stamp, before it (for deploy only)."""

    do: Verb


class Truth(Header, frozen=True):
    """The true pose of one MAV in the world frame (for deploy only)."""

    mav: int
    position: bytes  # (3,) m
    quaternion: bytes  # (4,) x y z w

    def __post_init__(self) -> None:
        _expect_floats("position", self.position, 3, limit=1e6)
        _expect_floats("quaternion", self.quaternion, 4, limit=1.001)


class Labels(Header, frozen=True):
    """Which MAV each detection of one sensor's set really was; 0 is a false detection (for deploy only)."""

    mav: int  # whose sensor
    targets: bytes  # uint8 (M,)


class Contact(Header, frozen=True):
    """Which MAVs one MAV has touched since the tick before; said only if there are any (for deploy only)."""

    mav: int
    others: bytes  # uint8 (M,): MAV numbers, ascending

    def __post_init__(self) -> None:
        if not self.others or sorted(set(self.others)) != list(self.others) or self.mav in self.others:
            raise ValueError(f"others: {list(self.others)}, expected ascending numbers of MAVs other than {self.mav}")


M = TypeVar("M", bound=Header)


def floats(block: bytes) -> Array:
    """A float64 block as a flat read-only array."""
    return np.frombuffer(block, "<f8")


def spherical_block(spherical: Array) -> bytes:
    """(M, 3) [range m, azimuth rad, elevation rad] as the wire has it."""
    return np.asarray(spherical, "<f4").tobytes()


def read_spherical(block: bytes) -> Array:
    """(M, 3) [range m, azimuth rad, elevation rad] of a detection set."""
    return np.frombuffer(block, "<f4").reshape(-1, 3).astype(np.float64)


def encode(message: Header) -> bytes:
    return _encoder.encode(message)


def encode_fields(kind: type[Header], *fields: object) -> bytes:
    """What `encode(kind(*fields))` gives, without building the message: that would check every field, and who receives
    it does so anyway."""
    return _encoder.encode(fields)


def header(payload: bytes, epoch: int) -> Header:
    """The header of a message of this run, without a look at the rest: cheap, so that rubbish is.

    Raises:
        Rejected: oversized, malformed, version, epoch, out-of-range (the first of these that holds).
    """
    if len(payload) > MAX_BYTES:
        raise Rejected("oversized", f"{len(payload)} bytes, at most {MAX_BYTES} are allowed")
    try:
        found = _header.decode(payload)
    except _UNREADABLE as error:
        raise Rejected("version" if _other_version(payload) else "malformed", str(error)) from None
    if found.version != VERSION:
        raise Rejected("version", f"{found.version}, this program speaks {VERSION}")
    if found.epoch != epoch:
        raise Rejected("epoch", f"{found.epoch}, this run is {epoch}")
    if not (0 <= found.sender < 256 and 0 <= found.seq < 2**63 and abs(found.stamp_ns) < 2**62):
        raise Rejected("malformed", f"sender {found.sender}, seq {found.seq} or stamp {found.stamp_ns} ns")
    return found


def decode(kind: type[M], payload: bytes, epoch: int) -> M:
    """The message in this payload.

    Raises:
        Rejected: as `header` does; then malformed.
    """
    header(payload, epoch)
    decoder = _decoders.get(kind)
    if decoder is None:
        decoder = _decoders[kind] = msgspec.msgpack.Decoder(kind)
    try:
        message: M = decoder.decode(payload)
    except _UNREADABLE as error:
        raise Rejected("malformed", str(error)) from None
    return message


class _AnyHeader(Header, frozen=True, forbid_unknown_fields=False):
    """What follows is skipped."""


_UNREADABLE = (msgspec.ValidationError, msgspec.DecodeError, UnicodeDecodeError, RecursionError)
_header = msgspec.msgpack.Decoder(_AnyHeader)
_encoder = msgspec.msgpack.Encoder()
_decoders: dict[type[Header], msgspec.msgpack.Decoder[Any]] = {}


def _other_version(payload: bytes) -> bool:
    """Whether an undecodable payload at least says that it is of another version: array header, then an integer."""
    return len(payload) > 1 and 0x90 <= payload[0] <= 0x9F and payload[1] < 0x80 and payload[1] != VERSION


def _expect_floats(
    name: str, block: bytes, count: int | None, *, multiple: int = 1, dtype: str = "<f8", limit: float
) -> None:
    size = np.dtype(dtype).itemsize
    if (count is not None and len(block) != size * count) or len(block) % (size * multiple):
        raise ValueError(f"{name}: {len(block)} bytes, expected {count or f'a multiple of {multiple}'} numbers")
    if len(block) <= 4 * size:  # plain floats are faster for a few numbers
        values = struct.unpack(f"<{len(block) // size}{'d' if size == 8 else 'f'}", block)
        inside = all(-limit < value < limit for value in values)
    else:
        inside = bool(np.abs(np.frombuffer(block, dtype)).max() < limit)  # false also for NaN
    if not inside:
        raise ValueError(f"non-finite or out of range: {name}")


def _expect_spherical(block: bytes) -> None:
    if len(block) % 12 or len(block) > 12 * MAX_DETECTIONS:
        raise ValueError(f"spherical: {len(block)} bytes, expected up to {MAX_DETECTIONS} times 3 float32")
    values = np.frombuffer(block, "<f4").reshape(-1, 3)
    if not ((values > _SPHERICAL_LOW) & (values < _SPHERICAL_HIGH)).all():
        raise ValueError("non-finite or out of range: spherical")


_SPHERICAL_LOW = np.array([0.0, -6.3, -1.6], "<f4")
_SPHERICAL_HIGH = np.array([1e4, 6.3, 1.6], "<f4")
