"""Does a person see in which state every agent is, and why?"""

import io

import numpy as np
import pytest
from rich.console import Console

from agent.interface import messages, topics
from agent.interface.bus import Packet
from agent.interface.fleet import Fleet
from deploy import terminal
from deploy.progress import MavProgress, Progress, Watch
from tests.deploy.conftest import registration

EPOCH = 7
FLEET = Fleet(mavs=3)
WHY = "two places fit [the second is a mirror image of the first, seen from below and turned by half a turn]"


def truth(mav: int) -> Packet:
    """MAV 1 is at 1 m along x, and so on; all look along x."""
    position, quaternion = np.array([mav, 0.0, 0.0]).tobytes(), np.array([0.0, 0, 0, 1]).tobytes()
    message = messages.Truth(messages.VERSION, EPOCH, 0, 0, 0, mav, position, quaternion)
    return Packet(topics.key(topics.TRUTH, mav), messages.encode(message))


def estimate(mav: int, states: list[int], xs: list[float]) -> Packet:
    poses = np.array([[x, 0.0, 0.0, 0.0] for x in xs])
    count = len(states)
    blocks = (bytes(states), poses.tobytes(), np.ones(10 * count, "<f4").tobytes(), bytes(32))
    message = messages.Estimate(messages.VERSION, EPOCH, mav, 0, 0, *blocks, 0, 0)
    return Packet(topics.key(topics.ESTIMATE, mav), messages.encode(message))


def seen(*packets: Packet) -> tuple[MavProgress, ...]:
    watch = Watch(FLEET, EPOCH)
    for packet in packets:
        watch.see(packet)
    return watch.now().mavs


def test_an_agent_is_shown_with_what_it_says_of_the_mav_it_knows_least_about() -> None:
    first, second, third = seen(
        *map(truth, FLEET.ids),
        estimate(1, [2, 2, 1], [0.0, 1.1, 77.0]),  # where it does not know it need not be right
        registration(1, EPOCH, ["", "", WHY], 2),
        estimate(2, [2, 2, 2], [-1.0, 0.0, 1.3]),
        registration(2, EPOCH, ["of old", "", "of old"], 2),
        estimate(3, [0, 0, 2], [9.0, 9.0, 0.0]),
    )
    assert (first.state, first.least_known, first.reason, first.localised) == ("ambiguous", 3, WHY, 1)
    assert first.error_m == pytest.approx(0.1)
    assert (second.state, second.least_known, second.reason, second.localised) == ("localised", None, "", 2)
    assert second.error_m == pytest.approx(np.sqrt(0.3**2 / 2))
    assert third == MavProgress(3, "searching", 1, "", 0, None)


def test_who_said_nothing_or_nonsense_is_searching() -> None:
    nonsense = Packet(topics.key(topics.REGISTRATION, 3), b"\xff")
    few = registration(2, EPOCH, ["one too few", ""], 1)
    second, third = estimate(2, [1, 2, 2], [0, 0, 0]), estimate(3, [0, 0, 2], [0, 0, 0])
    mavs = seen(Packet("belief/1/estimate", b""), second, few, third, nonsense)
    assert [(mav.state, mav.reason) for mav in mavs] == [("searching", ""), ("ambiguous", ""), ("searching", "")]


def progress(*mavs: MavProgress) -> Progress:
    return Progress(1.0, 5.0, mavs)


LOST = MavProgress(1, "searching", 2, "", 0, None)
TORN = MavProgress(2, "ambiguous", 1, WHY, 1, 0.2, lost=0.31, tick_ms=12.4)
SURE = MavProgress(3, "localised", None, "", 2, 0.125)


def test_in_words() -> None:
    assert terminal.in_words(progress(SURE, SURE)) == (
        "2 of 2 MAVs have localised all others, largest relative error 0.12 m"
    )
    assert terminal.in_words(progress(LOST, TORN, SURE, LOST)) == (
        "1 of 4 MAVs have localised all others, 1 ambiguous, 2 searching "
        "(MAV 2 about MAV 1: two places fit [the second is a mirror image of the ...), largest relative error 0.20 m, "
        "up to 31 % lost, slowest tick 12 ms"
    )
    assert terminal.in_words(progress(LOST)) == (
        "0 of 1 MAVs have localised all others, 1 searching, largest relative error unknown"
    )


def drawn(shown: Progress, width: int) -> str:
    file = io.StringIO()
    Console(file=file, width=width).print(terminal.as_table(shown, "title", "caption"))
    return file.getvalue()


def test_a_title_is_shown_as_it_is() -> None:
    file = io.StringIO()
    Console(file=file, width=90).print(terminal.as_table(progress(SURE), "x[bold]y[/i]", "caption"))
    assert "x[bold]y[/i]" in file.getvalue()


def test_as_a_table_reasons_take_the_room_there_is() -> None:
    text = drawn(progress(LOST, TORN, SURE), 90)
    assert [line for line in text.splitlines() if "ambiguous" in line] == [
        "│   2 │ ambiguous │    1 of 2 │        0.200 m │ 31 % │ 12 ms │ MAV 1: two places fit [… │"
    ]
    assert all(state in text for state in messages.STATES)
    assert max(map(len, text.splitlines())) <= 90
    assert len(text.splitlines()) == len(drawn(progress(LOST, SURE, SURE), 90).splitlines())  # one line each


def test_without_reasons_there_is_no_column_for_them() -> None:
    assert "why" in drawn(progress(TORN), 90)
    assert "why" not in drawn(progress(LOST, SURE), 90)


def test_lines_for_pipes_say_it_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    plain = terminal.Plain()
    plain.show(progress(TORN))
    plain.show(progress(SURE))  # too soon
    assert capsys.readouterr().out == f"   1.0 of 5 s, starting; {terminal.in_words(progress(TORN))}\n"


def status(mav: int, neighbours: list[int], holding: bool = False, received: int = 3) -> Packet:
    counters = (1, 2, received, 4, 5, 6, 7000, (8,))
    header = (messages.VERSION, EPOCH, mav, 0, 0)
    message = messages.Status(*header, *counters, neighbours=bytes(neighbours), holding=holding)
    return Packet(topics.key(topics.STATUS, mav), messages.encode(message))


def test_who_is_not_there_any_more_is_seen() -> None:
    first, second, third = seen(status(1, [0, 1, 2]), status(2, [0, 0, 2], holding=True))
    assert (first.stale, first.gone, first.holding) == ((2,), (3,), False)
    assert (second.stale, second.gone, second.holding) == ((), (3,), True)
    assert (third.stale, third.gone, third.holding) == ((), (), False)
    shown = progress(first, second, third)
    assert ", stale: MAV 2, gone: MAV 3, holding: MAV 2, largest" in terminal.in_words(shown)
    assert "3 gone, 2 stale" in drawn(shown, 90)
    assert "holding, 3 gone" in drawn(shown, 90)
    assert "neighbours" not in drawn(progress(third), 90)


@pytest.mark.parametrize(("received", "lost"), [(6, 0.0), (3, 0.5), (0, 1.0), (9, 0.0)])
def test_what_was_sent_and_did_not_come_is_lost(received: int, lost: float) -> None:
    """Of the two messages a tick of each of three MAVs; copies are no more than all."""
    first, *_ = seen(status(1, [0, 0, 0], received=received))
    assert (first.lost, first.tick_ms) == (lost, 7.0)
