"""Alive, stale or gone? From ages, and from tokens where there are any."""

import logging

import pytest

from agent.interface.messages import ALIVE, GONE, STALE
from agent.sensing.liveness import Liveness

S = 10**9


def test_by_the_age_of_what_it_said(caplog):
    liveness = Liveness(mav=2, mavs=3, stale_after_s=1.0, gone_after_s=3.0)
    liveness.look(20 * S, None)  # it has just come itself
    assert liveness.states == [ALIVE, ALIVE, ALIVE]
    liveness.heard(1, 21 * S)
    with caplog.at_level(logging.INFO):
        liveness.look(21 * S + S // 2, None)
    assert liveness.states == [ALIVE, ALIVE, STALE]
    assert caplog.messages == ["MAV 3 is stale at 21.5 s (last heard at 20.0 s)"]
    liveness.heard(3, 19 * S)  # late news make nobody younger
    liveness.look(23 * S + S // 2, None)
    assert liveness.states == [STALE, ALIVE, GONE]
    liveness.heard(3, 23 * S)
    liveness.look(23 * S + S // 2, None)
    assert liveness.states == [STALE, ALIVE, ALIVE]


@pytest.mark.parametrize(("token", "state"), [(True, STALE), (False, GONE)])
def test_by_its_token_if_there_are_any(token, state):
    liveness = Liveness(mav=1, mavs=2, stale_after_s=1.0, gone_after_s=3.0)
    liveness.heard(2, 0)
    liveness.look(2 * S, lambda mav: token)
    assert liveness.states == [ALIVE, state]


def test_who_was_heard_in_the_future_is_not_alive_for_ever():
    liveness = Liveness(mav=1, mavs=2, stale_after_s=1.0, gone_after_s=3.0)
    liveness.heard(2, 10**6 * S)
    liveness.look(0, None)
    liveness.look(4 * S, None)
    assert liveness.states == [ALIVE, GONE]
