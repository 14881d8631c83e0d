"""Who is not heard for seconds: how sure is it still where he is, and is he found again?"""

import numpy as np

from agent.config import AgentConfig
from agent.estimator.history import History
from agent.interface.fleet import Fleet
from agent.interface.messages import LOCALISED
from tests import links, team

MAVS, STATION = 4, 2
RECTANGLE = np.array([[0, 0, 1.5], [2, 0, 1.5], [2, 3, 1.5], [0, 3, 1.5]], float)


def flown(seed, ticks):
    return list(team.circling(np.random.default_rng(seed), MAVS, ticks))


def surveyed(ticks):
    history = History(AgentConfig(), Fleet(mavs=MAVS), STATION)
    history.start(team.frames_in(ticks[0].truth, STATION), 0.2, 0.1)
    return history


def unseen(ticks, mav, when):
    """The same ticks, but that nobody detects this MAV `when` (tick numbers)."""
    hidden = [tick._replace(sets=dict(tick.sets), labels=dict(tick.labels)) for tick in ticks]
    for k in when:
        sets, labels = hidden[k].sets, hidden[k].labels
        for station in sets:
            seen = labels[station] != mav
            sets[station], labels[station] = sets[station][seen], labels[station][seen]
    return hidden


def test_who_is_gone_grows_uncertain_without_bound_and_is_not_forgotten():
    ticks = unseen(flown(5, ticks=240), 4, range(31, 240))
    arrived = links.faulty(np.random.default_rng(5), ticks, STATION, lost=lambda k, mav: mav == 4 and k > 30)
    found = links.off(ticks, list(links.fly(surveyed(ticks), ticks, arrived, STATION)), STATION)
    gone = 2  # of the others
    variance = np.trace(found.covariances[:, gone, :3, :3], axis1=1, axis2=2)
    assert (np.diff(variance[31:]) > 0).all()  # no false detection is him
    assert variance[239] - variance[238] > 0.5 * (variance[60] - variance[59])  # not slower and slower
    assert np.linalg.norm(found.errors[239, gone, :3]) < 3  # it has not flown him away
    squares = found.errors[31:, gone, :3] ** 2 / found.covariances[31:, gone, range(3), range(3)]
    assert squares.mean() < 4


def test_who_comes_back_into_view_is_found_though_he_is_not_heard():
    ticks = unseen(flown(5, ticks=110), 4, range(31, 100))
    arrived = links.faulty(np.random.default_rng(5), ticks, STATION, lost=lambda k, mav: mav == 4 and k > 30)
    found = links.off(ticks, list(links.fly(surveyed(ticks), ticks, arrived, STATION)), STATION)
    error_m = np.linalg.norm(found.errors[:, 2, :3], axis=1)
    assert error_m[99] > 0.5
    assert error_m[103:].max() < 0.25


def test_the_reading_that_ends_a_silence_is_believed():
    ticks = flown(6, ticks=80)
    arrived = links.faulty(np.random.default_rng(6), ticks, STATION, lost=lambda k, mav: mav == 4 and 30 < k < 60)
    found = links.off(ticks, list(links.fly(surveyed(ticks), ticks, arrived, STATION)), STATION)
    trace = np.trace(found.covariances[:, 2, :3, :3], axis1=1, axis2=2)
    assert trace[59] > 2 * trace[30]
    assert trace[65] < 1.5 * trace[30]
    assert np.abs(found.errors[62:, 2, :3]).max() < 0.2


def test_who_is_not_heard_after_a_gap_is_not_localised():
    """Back after 5 s in which a team that was at rest may have set out: one of them has not been heard yet."""
    ticks = list(team.fly(np.random.default_rng(9), MAVS, 172, lambda _: RECTANGLE))
    history = surveyed(ticks)
    list(links.fly(history, ticks[:120], links.perfect(ticks, STATION)[:120], STATION))
    for k, heard in ((170, (1, 2, 3)), (171, (1, 2, 3, 4))):
        history.hear(k, {mav: ticks[k].odometry[mav] for mav in heard}, [])
        history.estimate()
        assert (history.beliefs().states == LOCALISED).tolist() == [mav in heard for mav in range(1, MAVS + 1)]
