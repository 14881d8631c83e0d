"""Do the autopilot's loops run as often as they say, and does the flight repeat itself?"""

import math

import numpy as np
import pytest

from agent.interface.fleet import Fleet
from world.config import parse
from world.simulated import SimulatedFlight

TABLE = {
    "path": [
        {"formation": "circle", "radius_m": 1.35},
        {"formation": "circle", "radius_m": 2.0, "move_s": 2.0},
    ]
}


def flight(rate_hz: float) -> SimulatedFlight:
    fleet = Fleet(mavs=3, rate_hz=rate_hz)
    return SimulatedFlight(parse(TABLE, fleet), fleet)


@pytest.mark.parametrize("rate_hz", [0.9, 7.0, 10.0, 30.0, 200.0])
def test_attitude_at_200_hz_or_more_and_position_at_50_hz_or_more(
    rate_hz: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    flown, calls = flight(rate_hz), []
    for name in ("aim", "commands"):
        loop = getattr(flown._autopilot, name)

        def count(*arguments: object, name: str = name, loop=loop) -> object:
            calls.append(name)
            return loop(*arguments)

        monkeypatch.setattr(flown._autopilot, name, count)
    ticks = math.ceil(4 * rate_hz)
    for _ in range(ticks):
        flown.step()
    inner_hz, outer_hz = (calls.count(name) * rate_hz / ticks for name in ("commands", "aim"))
    assert 200 - 1e-9 <= inner_hz < 400
    assert 50 - 1e-9 <= outer_hz < 80


def test_it_repeats_itself_to_the_last_bit() -> None:
    one, two = flight(10.0), flight(10.0)
    for _ in range(15):
        one.step()
        two.step()
    for a, b in ((one.true, two.true), (one.vio, two.vio)):
        assert np.array_equal(a.position, b.position)
        assert np.array_equal(a.quaternion, b.quaternion)
