"""Which ticks are complete, or as complete as they will be."""

import numpy as np

from agent.registration.waiting import SILENT_TICKS, Waiting
from agent.registration.window import Window

LAG = 10


class Rig:
    """Two peers and the station, index 0, which is always heard."""

    def __init__(self, mavs=3):
        self.waiting, self.window, self.mavs = Waiting(mavs, LAG, 0), Window(mavs, 50), mavs

    def hear(self, *packets):
        """A tick, with what comes in it: (tick, index, what)."""
        k = len(self.window.frames)
        frame = self.window.add(k, {0: np.zeros(4)})
        frame.put(0, np.zeros((0, 3)))
        for tick, mav, what in packets:
            self.waiting.heard(k, [mav])
            if "o" in what:
                self.window.frames[tick].put_odometry(mav, np.zeros(4))
            if "s" in what:
                self.window.frames[tick].put(mav, np.zeros((0, 3)))
                self.waiting.heard_set(k, tick, mav)
        return self.waiting.over(self.window.frames)


def test_what_is_complete_is_over_at_once():
    rig = Rig()
    assert [rig.hear((k, 1, "os"), (k, 2, "os")) for k in range(3)] == [1, 2, 3]


def test_a_constant_delay_is_waited_for_and_no_longer():
    rig = Rig()
    delay = 5
    over = [rig.hear(*((k - delay, mav, "os") for mav in (1, 2) if k >= delay)) for k in range(12)]
    assert over == [0] * delay + list(range(1, 12 - delay + 1))


def test_sets_may_come_later_than_the_odometry():
    rig = Rig()
    over = [
        rig.hear(*((k, mav, "o") for mav in (1, 2)), *((k - 4, mav, "s") for mav in (1, 2) if k >= 4)) for k in range(9)
    ]
    assert over == [0, 0, 0, 0, 1, 2, 3, 4, 5]


def test_a_lost_set_is_given_up_one_tick_after_the_next_came():
    rig = Rig()
    rig.hear((0, 1, "os"), (0, 2, "os"))
    assert rig.hear((1, 1, "os"), (1, 2, "o")) == 1
    assert rig.hear((2, 1, "os"), (2, 2, "os")) == 1
    assert rig.hear((3, 1, "os"), (3, 2, "os")) == 4


def test_a_lost_reading_is_made_good_by_the_next():
    rig = Rig()
    assert rig.hear((0, 1, "os"), (0, 2, "os")) == 1
    assert rig.hear((1, 1, "os"), (1, 2, "s")) == 1
    assert rig.hear((2, 1, "os"), (2, 2, "os")) == 3


def test_who_falls_silent_is_waited_for_a_while_and_not_again():
    rig = Rig()
    rig.hear((0, 1, "os"), (0, 2, "os"))
    over = [rig.hear((k, 1, "os")) for k in range(1, 10)]
    assert over == [1] * (SILENT_TICKS - 1) + list(range(SILENT_TICKS + 1, 11))


def test_who_was_never_heard_is_waited_for_as_long_as_the_lag():
    rig = Rig()
    over = [rig.hear((k, 1, "os")) for k in range(LAG + 2)]
    assert over == [0] * LAG + [LAG + 1, LAG + 2]


def test_after_the_lag_nothing_is_waited_for():
    """He goes on sending odometry, but no sets."""
    rig = Rig()
    over = [rig.hear((k, 1, "os"), (k, 2, "o")) for k in range(LAG + 3)]
    assert over == [0] * LAG + [1, 2, 3]
    assert rig.waiting.silence(LAG + 2).tolist() == [LAG + 3, 0, 0]
