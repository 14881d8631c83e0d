"""Who takes part from when on? Lines of JSON on standard input, from who starts and kills the agents.

`{"roll": [[mav, incarnation], ...], "until": tick, "absent": [mav, ...]}`: in lockstep the world holds before that
tick, says `{"held": tick}` on standard output and waits for the next line. In real time it looks for a line before each
tick and holds for nobody. With standard input at its end everybody takes part.
"""

import os
import sys
from collections.abc import Callable
from typing import Protocol

import msgspec

Incarnations = dict[int, int]  # by MAV: how often it has been started anew
Meet = Callable[[list[tuple[int, int]]], None]


class Call(msgspec.Struct, frozen=True):
    roll: list[tuple[int, int]]  # MAV and incarnation
    until: int | None
    absent: list[int]  # MAVs without a process


class Called(Protocol):
    """The world."""

    def set_roll(self, roll: Incarnations) -> None: ...
    def set_absent(self, mavs: set[int]) -> None: ...


class RollCall:
    """To be asked before every tick."""

    def __init__(self, world: Called, descriptor: int, meet: Meet) -> None:
        """
        Args:
            descriptor: of standard input.
            meet: returns when these MAVs and incarnations hear what is published.
        """
        self._world, self._descriptor, self._meet = world, descriptor, meet
        self._until: int | None = 0
        self._unread = b""

    def lockstep(self, tick: int) -> None:
        """Holds if it is time to."""
        if tick != self._until:
            return
        if tick:
            print(msgspec.json.encode({"held": tick}).decode(), flush=True)
        while b"\n" not in self._unread:
            if not self._read():
                self._until = None
                return
        line, _, self._unread = self._unread.partition(b"\n")
        call = msgspec.json.decode(line, type=Call)
        self._meet(call.roll)
        self._take(call)

    def realtime(self, _: int) -> None:
        """Takes in what has come."""
        os.set_blocking(self._descriptor, False)
        try:
            while self._read():
                pass
        except BlockingIOError:
            pass
        *lines, self._unread = self._unread.split(b"\n")
        for line in lines:
            self._take(msgspec.json.decode(line, type=Call))

    def _read(self) -> bool:
        more = os.read(self._descriptor, 65536)
        self._unread += more
        return bool(more)

    def _take(self, call: Call) -> None:
        self._until = call.until
        self._world.set_absent(set(call.absent))
        self._world.set_roll(dict(call.roll))


def standard_input() -> int:
    return sys.stdin.fileno()
