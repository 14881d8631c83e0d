"""Does the world hold when it is told to, and go on with those who take part?"""

import json
import os
from collections.abc import Iterator
from typing import Any

import pytest

from world.roll_call import RollCall


class World:
    def __init__(self) -> None:
        self.heard: list[Any] = []

    def set_roll(self, roll: dict[int, int]) -> None:
        self.heard.append(roll)

    def set_absent(self, mavs: set[int]) -> None:
        self.heard.append(mavs)

    def meet(self, agents: list[tuple[int, int]]) -> None:
        self.heard.append(agents)


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reading, writing = os.pipe()
    yield reading, writing
    os.close(reading)


def line(roll: list[tuple[int, int]], until: int | None, absent: list[int]) -> bytes:
    return json.dumps({"roll": roll, "until": until, "absent": absent}).encode() + b"\n"


def test_lockstep(pipe: tuple[int, int], capsys: pytest.CaptureFixture[str]) -> None:
    world = World()
    call = RollCall(world, pipe[0], world.meet)
    os.write(pipe[1], line([(1, 0), (2, 0)], 5, []) + line([(1, 0)], None, [2]))
    for tick in range(5):
        call.lockstep(tick)
    assert world.heard == [[(1, 0), (2, 0)], set(), {1: 0, 2: 0}]
    assert capsys.readouterr().out == ""
    call.lockstep(5)
    assert capsys.readouterr().out == '{"held":5}\n'
    assert world.heard[3:] == [[(1, 0)], {2}, {1: 0}]
    for tick in range(6, 50):
        call.lockstep(tick)  # and does not hold again


@pytest.mark.parametrize("way", ["lockstep", "realtime"])
def test_nobody_calls(pipe: tuple[int, int], way: str) -> None:
    world = World()
    call = RollCall(world, pipe[0], world.meet)
    os.close(pipe[1])
    for tick in range(3):
        getattr(call, way)(tick)
    assert world.heard == []


def test_real_time_holds_for_nobody(pipe: tuple[int, int]) -> None:
    world = World()
    call = RollCall(world, pipe[0], world.meet)
    call.realtime(0)
    os.write(pipe[1], line([(1, 0)], 1, [2])[:20])
    call.realtime(1)
    assert world.heard == []
    os.write(pipe[1], line([(1, 0)], 1, [2])[20:] + line([(1, 0), (2, 1)], None, []))
    call.realtime(2)
    assert world.heard == [{2}, {1: 0}, set(), {1: 0, 2: 1}]
