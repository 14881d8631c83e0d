"""Messages that an agent must not believe: rubbish, damaged, of other runs, of other times, in another's name.

`breaks` is the plain twin of the boundary: written against the text of the message classes, with another decoder.
"""

import msgpack
import numpy as np

from agent.interface import messages as m
from agent.interface import topics
from agent.interface.bus import Packet

BODIES = {
    topics.VIO: ["floats 3", "quaternion"],
    topics.SIGHTINGS: ["spherical"],
    topics.SURVEY: ["survey", "sigma", "sigma"],
    topics.END: [],
    topics.ODOMETRY: ["floats 4"],
    topics.DETECTIONS: ["spherical"],
}


class Enemy:
    """Draws packets of a fleet at 10 Hz that break the rules at `now_ns`, out of real ones."""

    def __init__(self, seed, mavs, epoch, real):
        self.rng, self.mavs, self.epoch = np.random.default_rng(seed), mavs, epoch
        self.real = [packet for packet in real if topics.parse(packet.key)[0] in BODIES]
        self.ways = (self.rubbish, self.damaged, self.rewritten, self.of_another_run, self.of_another_time, self.liar)

    def packet(self, now_ns):
        while True:
            way = self.ways[self.rng.integers(len(self.ways))]
            packet = way(self.real[self.rng.integers(len(self.real))], now_ns)
            if breaks(packet, self.mavs, self.epoch, now_ns):
                return packet

    def rubbish(self, real, now_ns):
        return Packet(real.key, self.rng.bytes(int(self.rng.integers(0, 300))))

    def damaged(self, real, now_ns):
        """Cut, lengthened, or some bytes of it changed."""
        payload, rng = bytearray(self.timed(real, now_ns)), self.rng
        kind = rng.integers(3)
        if kind == 0:
            payload = payload[: rng.integers(len(payload))]
        elif kind == 1:
            payload += rng.bytes(int(rng.integers(1, 50)))
        else:
            for _ in range(rng.integers(1, 9)):
                payload[rng.integers(len(payload))] = rng.integers(256)
        return Packet(real.key, bytes(payload))

    def rewritten(self, real, now_ns):
        """A field is another thing, or a number in a block is none."""
        fields, rng = msgpack.unpackb(self.timed(real, now_ns)), self.rng
        place = int(rng.integers(len(fields)))
        if isinstance(fields[place], bytes) and len(fields[place]) >= 8 and rng.random() < 0.6:
            block = np.frombuffer(fields[place], "<f4").copy()
            block[rng.integers(len(block))] = rng.choice([np.nan, np.inf, -np.inf, 1e30])
            fields[place] = block.tobytes()
        else:
            odd = [None, -1, 2**63, 1e300, float("nan"), b"", b"x" * 9, "text", [], {}, [[[]]], True, bytes(40_000)]
            fields[place] = odd[rng.integers(len(odd))]
        return Packet(real.key, msgpack.packb(fields))

    def of_another_run(self, real, now_ns):
        fields = msgpack.unpackb(self.timed(real, now_ns))
        fields[int(self.rng.integers(2))] += int(self.rng.choice([-1, 1, 1000]))  # version or epoch
        return Packet(real.key, msgpack.packb(fields))

    def of_another_time(self, real, now_ns):
        fields = msgpack.unpackb(real.payload)
        fields[4] = int(now_ns + self.rng.choice([50_000_000, -30_000_000, 10**10, 10**14, 2**61]))
        return Packet(real.key, msgpack.packb(fields))

    def liar(self, real, now_ns):
        """The sender is not whose key it is, or there is no such MAV or topic."""
        kind, mav, *rest = real.key.split("/")
        mav = self.rng.choice([str(self.rng.integers(0, 1000)), "", "x", "-1", "²", mav])
        rest = [str(self.rng.choice(["pose", "", "vio/x", "odometry"]))] if self.rng.random() < 0.3 else rest
        return Packet("/".join([kind, str(mav), *rest]), self.timed(real, now_ns))

    def timed(self, real, now_ns):
        fields = msgpack.unpackb(real.payload)
        fields[4] = now_ns
        return msgpack.packb(fields)


def breaks(packet, mavs, epoch, now_ns):
    """Whether a packet is no message for an agent of this fleet (at 10 Hz) whose newest reading is of `now_ns`."""
    chunks = packet.key.split("/")
    shape = [chunks[0], "{mav}", *chunks[2:]]
    topic = next((topic for topic in topics.TOPICS if topic.key.split("/") == shape), None)
    if topic not in BODIES or not (chunks[1].isascii() and chunks[1].isdecimal() and 1 <= int(chunks[1]) <= mavs):
        return True
    try:
        fields = msgpack.unpackb(packet.payload, strict_map_key=False)
    except (ValueError, TypeError, msgpack.exceptions.UnpackException):
        return True
    if not isinstance(fields, list) or len(fields) != 5 + len(BODIES[topic]) or len(packet.payload) > m.MAX_BYTES:
        return True
    header, body = fields[:5], fields[5:]
    if any(type(value) is not int for value in header):
        return True
    version, of, sender, seq, stamp_ns = header
    sent_by = int(chunks[1]) if topic.key.startswith("air/") else 0
    if (version, of, sender) != (m.VERSION, epoch, sent_by) or not 0 <= seq < 2**63:
        return True
    if abs(stamp_ns) >= 2**62:
        return True
    if topic not in (topics.SURVEY, topics.END) and (
        off_beat(stamp_ns) or stamp_ns > now_ns + (6.5e9 if sent_by else 60e9)
    ):
        return True
    return not all(fits(value, what, mavs) for value, what in zip(body, BODIES[topic], strict=True))


def off_beat(stamp_ns):
    return 25_000_000 < stamp_ns % 100_000_000 < 75_000_000


def fits(value, what, mavs):
    if what == "sigma":
        return type(value) in (int, float) and 0 < value < 1000
    if type(value) is not bytes:
        return False
    if what == "spherical":
        if len(value) % 12 or len(value) > 12 * m.MAX_DETECTIONS:
            return False
        r, azimuth, elevation = np.frombuffer(value, "<f4").reshape(-1, 3).T
        return bool(((r > 0) & (r < 1e4) & (abs(azimuth) < 6.3) & (abs(elevation) < 1.6)).all())
    count = {"floats 3": 3, "floats 4": 4, "quaternion": 4, "survey": 4 * mavs}[what]
    if len(value) != 8 * count:
        return False
    numbers = np.frombuffer(value, "<f8")
    if what == "quaternion":
        return bool((abs(numbers) < 1.001).all() and abs(numbers @ numbers - 1) <= 2e-3)
    return bool((abs(numbers) < 1e6).all())
