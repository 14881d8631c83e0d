"""Does a log give back what was written, also when its writer was killed?"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from agent.interface import messages, topics
from agent.interface.bus import Packet
from deploy.log import BadLog, LogWriter, Origin, read_log, schema_text
from deploy.peek import peek
from tests.deploy.conftest import registration

ORIGIN = Origin(7, "memory", "[fleet]\nmavs = 2\n")


def odometry(seq: int, epoch: int = 7) -> Packet:
    block = bytes(24) + bytes(8)
    message = messages.Odometry(messages.VERSION, epoch, 1, seq, seq * 10**8, block)
    return Packet(topics.key(topics.ODOMETRY, 1), messages.encode(message))


def write(path: Path, packets: list[Packet]) -> None:
    with LogWriter(path, ORIGIN) as writer:
        for packet in packets:
            writer.write(packet, peek(packet.payload))


def test_round_trip_also_of_what_is_no_message(tmp_path: Path) -> None:
    packets = [odometry(0), Packet("air/1/odometry", b"\xff\x00nonsense"), Packet("who/knows", b""), odometry(1)]
    write(tmp_path / "log.mcap", packets)
    log = read_log(tmp_path / "log.mcap")
    assert log.packets == packets
    assert log.origin == ORIGIN
    assert log.wall_s is not None


def test_times_sequence_numbers_and_schemas_are_there_for_other_tools(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    write(tmp_path / "log.mcap", [odometry(0), odometry(3), Packet("who/knows", b"")])
    with (tmp_path / "log.mcap").open("rb") as file:
        found = [(s and s.name, c.topic, c.message_encoding, m) for s, c, m in make_reader(file).iter_messages()]
    assert [(schema, topic, encoding) for schema, topic, encoding, _ in found] == [
        ("Odometry", "air/1/odometry", "msgpack"),
        ("Odometry", "air/1/odometry", "msgpack"),
        (None, "who/knows", "msgpack"),
    ]
    assert [(m.log_time, m.publish_time, m.sequence) for *_, m in found[:2]] == [(0, 0, 0), (300000000, 300000000, 3)]


def test_a_schema_names_every_field_in_order() -> None:
    schema = json.loads(schema_text(messages.Estimate))
    names = [item["title"] for item in schema["prefixItems"]]
    assert names[:5] == ["version", "epoch", "sender", "seq", "stamp_ns"]
    assert names[5:8] == ["states", "poses", "covariances"]


def test_a_registration_is_recorded_with_its_schema(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    packet = registration(1, 7, ["", "two places fit"], 2)
    write(tmp_path / "log.mcap", [packet])
    assert read_log(tmp_path / "log.mcap").packets == [packet]
    with (tmp_path / "log.mcap").open("rb") as file:
        ((schema, channel, _),) = make_reader(file).iter_messages()
    assert (schema.name, channel.topic) == ("Registration", "belief/1/registration")
    items = json.loads(schema.data)["prefixItems"]
    assert [item["title"] for item in items[5:]] == ["reasons", "weights", "placed", "poses"]
    assert items[5]["items"] == {"type": "string"}


def flushed_log(folder: Path) -> tuple[Path, list[Packet]]:
    """A log of 400 messages that was flushed after every 50."""
    path = folder / "log.mcap"
    packets = [odometry(seq) for seq in range(400)]
    with LogWriter(path, ORIGIN) as writer:
        for packet in packets:
            writer.write(packet, peek(packet.payload))
            if peek(packet.payload).seq % 50 == 49:
                writer.flush()
    return path, packets


@pytest.mark.parametrize("share", [0.3, 0.6, 0.999])
def test_a_truncated_log_gives_what_came_before(tmp_path: Path, share: float) -> None:
    path, packets = flushed_log(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    log = read_log(path)
    assert log.packets == packets[: len(log.packets)]
    assert len(log.packets) >= 50
    assert log.origin == ORIGIN


def test_what_was_flushed_survives_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    program = f"""
import sys, signal
from pathlib import Path
from deploy.log import LogWriter, Origin
from deploy.peek import peek
from tests.deploy.test_log import odometry, ORIGIN
writer = LogWriter(Path({str(path)!r}), ORIGIN)
for seq in range(100):
    writer.write(odometry(seq), peek(odometry(seq).payload))
writer.flush()
for seq in range(100, 105):
    writer.write(odometry(seq), peek(odometry(seq).payload))
print("written", flush=True)
signal.pause()
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "written\n"
        os.kill(child.pid, signal.SIGKILL)
    log = read_log(path)
    assert log.packets == [odometry(seq) for seq in range(100)]
    assert log.wall_s is None


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadLog, match="No such file"):
        read_log(tmp_path / "log.mcap")
    (tmp_path / "log.mcap").write_bytes(b"something else entirely")
    with pytest.raises(BadLog, match="not the log of a run"):
        read_log(tmp_path / "log.mcap")


def test_a_damaged_log_gives_what_came_before(tmp_path: Path) -> None:
    path, packets = flushed_log(tmp_path)
    whole = bytearray(path.read_bytes())
    middle = 2 * len(whole) // 5  # among the messages, not in an index of them
    whole[middle : middle + 200] = bytes(200)
    path.write_bytes(whole)
    log = read_log(path)
    assert log.packets == packets[: len(log.packets)]
    assert 50 <= len(log.packets) < 400


def test_a_chunk_of_a_length_that_no_file_has_ends_the_log(tmp_path: Path) -> None:
    path, packets = flushed_log(tmp_path)
    whole = bytearray(path.read_bytes())
    at = 8  # after the magic: records of a code, a length and so many bytes
    while at < 2 * len(whole) // 5 or whole[at] != 0x06:  # a chunk
        at += 9 + int.from_bytes(whole[at + 1 : at + 9], "little")
    at += 9 + 8 + 8 + 8 + 4  # its times, size and checksum, then how it is compressed, then the length of its records
    at += 4 + int.from_bytes(whole[at : at + 4], "little")
    whole[at : at + 8] = bytes([0xFF]) * 8
    path.write_bytes(whole)
    log = read_log(path)
    assert log.packets == packets[: len(log.packets)]
    assert 50 <= len(log.packets) < 400
