"""What is in log.mcap? Every message of a run, one channel per topic key; written and read here, also after a crash.

The log stands alone: it begins with the resolved experiment. A log whose writer was killed is readable up to its last
flush.
"""

import json
import struct
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple, Self

import msgspec
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from agent.interface import clock, messages, topics
from agent.interface.bus import Packet
from deploy.peek import Peek

CHUNK_BYTES = 256 * 1024


class Origin(NamedTuple):
    """Which run this is the log of."""

    epoch: int
    transport: str  # zenoh | memory
    experiment: str  # the resolved experiment, TOML


class LogWriter:
    """Appends packets to a log; leave it by `with`, so that the file gets its index."""

    def __init__(self, path: Path, origin: "Origin") -> None:
        self._file: IO[bytes] = path.open("wb")
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="swarm")
        self._writer.add_metadata("run", {name: str(value) for name, value in origin._asdict().items()})
        self._began_s = self._ended_s = clock.now_s()
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._stamp_ns = self._count = 0
        self.flush()

    def write(self, packet: Packet, header: Peek | None) -> None:
        """Records whatever it is; a payload without a header gets the time of the message before it."""
        channel = self._channels.get(packet.key)
        if channel is None:
            channel = self._channels[packet.key] = self._writer.register_channel(
                topic=packet.key, message_encoding="msgpack", schema_id=self._schema(packet.key)
            )
        self._ended_s = clock.now_s()
        if not self._count:
            self._began_s = self._ended_s
        self._count += 1
        sequence = 0
        if header is not None and 0 <= header.stamp_ns < 2**62:
            self._stamp_ns, sequence = header.stamp_ns, header.seq & 0xFFFFFFFF
        self._writer.add_message(channel, self._stamp_ns, packet.payload, self._stamp_ns, sequence)

    def flush(self) -> None:
        """What was written so far survives a kill."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._writer.add_metadata("end", {"wall_s": f"{self._ended_s - self._began_s:.3f}"})
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def _schema(self, key: str) -> int:
        try:
            topic, _ = topics.parse(key)
        except messages.Rejected:
            return 0  # mcap's "no schema"
        known = self._schemas.get(topic.name)
        if known is None:
            known = self._schemas[topic.name] = self._writer.register_schema(
                name=topic.kind.__name__, encoding="jsonschema", data=schema_text(topic.kind).encode()
            )
        return known


def schema_text(kind: type[messages.Header]) -> str:
    """JSON Schema of a message: an array whose items are the fields in order."""
    definition: dict[str, Any] = msgspec.json.schema(kind)["$defs"][kind.__name__]
    for field, item in zip(msgspec.structs.fields(kind), definition["prefixItems"], strict=True):
        item["title"] = field.name
        if item.get("contentEncoding") == "base64":  # in JSON it would be; msgpack has binary
            item["contentEncoding"] = "binary"
    definition["$comment"] = messages.__doc__  # how blocks of numbers are encoded
    return json.dumps(definition)


class Log(NamedTuple):
    """What a log file holds."""

    origin: Origin
    packets: list[Packet]  # in the order in which they were recorded
    wall_s: float | None  # from the first message to the last; None if the writer did not come to say it


class BadLog(Exception):
    """The file is not a log of a run."""


def read_log(path: Path) -> Log:
    """Reads a log, also one that ends in the middle.

    Raises:
        BadLog: there is no such file, or its beginning is not that of a run's log.
    """
    packets: list[Packet] = []
    keys: dict[int, str] = {}
    origin: Origin | None = None
    wall_s: float | None = None
    try:
        with path.open("rb") as stream:
            records: Iterable[object] = StreamReader(stream).records
            for record in records:
                if isinstance(record, Message):
                    packets.append(Packet(keys[record.channel_id], record.data))
                elif isinstance(record, Channel):
                    keys[record.id] = record.topic
                elif isinstance(record, Metadata) and record.name == "run":
                    run = record.metadata
                    origin = Origin(int(run["epoch"]), run["transport"], run["experiment"])
                elif isinstance(record, Metadata) and record.name == "end":
                    wall_s = float(record.metadata["wall_s"])
    except OSError as error:
        raise BadLog(f"{path}: {error.strerror}") from None
    except (McapError, struct.error, zstandard.ZstdError, KeyError, ValueError, OverflowError, MemoryError):
        pass  # the end is missing, or it is damaged: what comes before counts
    if origin is None:
        raise BadLog(f"{path}: not the log of a run")
    return Log(origin, packets, wall_s)
