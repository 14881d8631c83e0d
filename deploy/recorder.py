"""What was said in the run? The recorder process: every message goes to log.mcap, progress to its standard output.

Started like every process of a run (`python -m deploy.recorder RUN/experiment.toml --network FILE --epoch E`), it
writes log.mcap beside the experiment file. On SIGTERM it goes on until it has all that the others' last words announce.
"""

import contextlib
import logging
import os
import signal
import sys
from pathlib import Path

import msgspec

from agent.interface import clock, messages, topics
from agent.interface.bus import BusError, Inbox, Packet
from agent.interface.process import Start, arguments, join, on_the_bus, stop_on_signals
from deploy.log import LogWriter, Origin
from deploy.peek import peek
from deploy.progress import Watch

PAUSE_S = 0.01  # between looks into the inbox: a few hundred messages at most
PROGRESS_S = 0.5
SAVE_S = 1.0  # a killed recorder loses no more than this
WAIT_S = 5.0  # after SIGTERM, for what was announced ...
SILENCE_S = 1.0  # ... and while anything still comes

log = logging.getLogger("recorder")


class Ledger:
    """Who has said how many messages, and how many they say there were."""

    def __init__(self, epoch: int) -> None:
        self._epoch = epoch
        self.received: dict[int, int] = {}
        self.announced: dict[int, int] = {}
        self.undecodable = 0
        self._excused: set[int] = set()

    def enter(self, packet: Packet, sender: int) -> None:
        self.received[sender] = self.received.get(sender, 0) + 1
        if packet.key.startswith("status/"):
            try:
                status = messages.decode(messages.Status, packet.payload, self._epoch)
            except messages.Rejected:
                self.undecodable += 1
                return
            if status.final:
                self.announced[status.sender] = status.sent

    def suffer(self, mav: int, do: str) -> None:
        """A process that was killed or stopped has no last words; a new one counts anew."""
        (self._excused.add if do in ("kill", "stop") else self._excused.discard)(mav)
        if do in ("restart", "join"):
            self.received[mav] = 0

    def missing(self, senders: range) -> list[str]:
        """What is not here, in words; empty when all is."""
        words = []
        for sender in senders:
            who, received = f"mav_{sender}" if sender else "world", self.received.get(sender, 0)
            sent = self.announced.get(sender)
            if sent is None and sender not in self._excused:
                words.append(f"{who}: no last words, {received} messages recorded")
            elif sent is not None and sent > received:
                words.append(f"{who}: {sent - received} of {sent} messages")
        return words


class Journal:
    """What befalls processes, as lines of JSON on standard input from who does it to them."""

    def __init__(self, epoch: int) -> None:
        self._epoch, self._unread, self._entries = epoch, b"", 0
        os.set_blocking(sys.stdin.fileno(), False)

    def read(self) -> list[tuple[int, messages.ProcessFault]]:
        """What has happened since the last look, and to which MAV."""
        with contextlib.suppress(BlockingIOError):
            self._unread += os.read(sys.stdin.fileno(), 65536)
        *lines, self._unread = self._unread.split(b"\n")
        return [self._entry(msgspec.json.decode(line, type=Entry)) for line in lines]

    def _entry(self, entry: "Entry") -> tuple[int, messages.ProcessFault]:
        header = (messages.VERSION, self._epoch, messages.DEPLOY, self._entries, entry.stamp_ns)
        self._entries += 1
        return entry.mav, messages.ProcessFault(*header, do=entry.do)


class Entry(msgspec.Struct, frozen=True):
    mav: int
    do: messages.Verb
    stamp_ns: int


class Stopping:
    """Whether SIGTERM has come, and since when."""

    def __init__(self) -> None:
        self.since_s: float | None = None

    def __call__(self, *_: object) -> None:
        if self.since_s is None:
            self.since_s = clock.now_s()


class Recorder:
    def __init__(self, start: Start, writer: LogWriter) -> None:
        self._epoch, self._writer = start.epoch, writer
        self._senders = range(start.fleet.mavs + 1)
        self._ledger, self._watch = Ledger(start.epoch), Watch(start.fleet, start.epoch)
        self._journal = Journal(start.epoch)

    def record(self, inbox: Inbox, stopping: Stopping) -> None:
        """Returns once it was told to stop and has everything, or has waited long enough."""
        heard_s = told_s = saved_s = clock.now_s()
        while True:
            for mav, fault in self._journal.read():
                self._ledger.suffer(mav, fault.do)
                self._take(Packet(topics.key(topics.PROCESS_FAULT, mav), messages.encode(fault)))
            packets, now_s = inbox.drain(), clock.now_s()
            for packet in packets:
                self._take(packet)
            if now_s - saved_s > SAVE_S:
                self._writer.flush()
                saved_s = now_s
            if now_s - told_s > PROGRESS_S:
                self._tell()
                told_s = now_s
            if packets:
                heard_s = now_s
                continue
            if stopping.since_s is not None:
                silent = now_s - max(heard_s, stopping.since_s) > SILENCE_S
                if silent or now_s - stopping.since_s > WAIT_S or not self._ledger.missing(self._senders):
                    return self._tell()
            clock.sleep_until(now_s + PAUSE_S)

    def complain(self) -> None:
        """Says what is not in the log."""
        for words in self._ledger.missing(self._senders):
            log.warning("missing from %s", words)
        if self._ledger.undecodable:
            log.warning("%d recorded payloads are not messages", self._ledger.undecodable)

    def _take(self, packet: Packet) -> None:
        header = peek(packet.payload)
        self._writer.write(packet, header)
        self._watch.see(packet)
        if header is None:
            self._ledger.undecodable += 1
        elif header.epoch == self._epoch:
            self._ledger.enter(packet, header.sender)

    def _tell(self) -> None:
        """One line of JSON for the launcher."""
        print(msgspec.json.encode(self._watch.now()).decode(), flush=True)


def main() -> int:
    start = arguments("python -m deploy.recorder")
    folder = Path(sys.argv[1]).parent
    stop_on_signals()  # nothing to wait for yet
    origin = Origin(start.epoch, "zenoh", (folder / "experiment.toml").read_text())
    try:
        with on_the_bus(start) as bus, LogWriter(folder / "log.mcap", origin) as writer:
            inbox = bus.subscribe("**")
            join(start, bus)
            stopping, recorder = Stopping(), Recorder(start, writer)
            signal.signal(signal.SIGTERM, stopping)
            recorder.record(inbox, stopping)
    except BusError as error:
        log.error("%s", error)
        return 1
    recorder.complain()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
