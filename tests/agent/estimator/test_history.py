"""Late, lost and repeated data: whatever the network does within the lag, the belief is what it would have been."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.config import AgentConfig
from agent.estimator.estimator import Estimator
from agent.estimator.history import History
from agent.interface.fleet import Fleet
from agent.interface.frames import compose, relative_pose
from agent.interface.messages import LOCALISED
from tests import links, team

MAVS, STATION, LAG = 4, 2, 10


def flown(seed=0, mavs=MAVS, ticks=40, path=team.circling):
    return list(path(np.random.default_rng(seed), mavs, ticks))


def surveyed(ticks, station=STATION, config=None):
    history = History(config or AgentConfig(), Fleet(mavs=len(ticks[0].truth)), station)
    history.start(team.frames_in(ticks[0].truth, station), 0.2, 0.1)
    return history


def last(ticks, arrived, **how):
    *_, found = links.fly(surveyed(ticks, **how), ticks, arrived, STATION)
    return found


def same(one, other, atol=0.0):
    for a, b in ((one.poses, other.poses), (one.covariances, other.covariances), (one.start, other.start)):
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def test_nothing_late_is_the_plain_filter_to_the_last_bit():
    ticks = flown()
    estimator = Estimator(AgentConfig(), Fleet(mavs=MAVS), STATION)
    estimator.start(team.frames_in(ticks[0].truth, STATION), 0.2, 0.1)
    for tick, found in zip(
        ticks, links.fly(surveyed(ticks), ticks, links.perfect(ticks, STATION), STATION), strict=True
    ):
        estimator.predict(tick.odometry)
        estimator.associate_all([links.untold(tick, mav) for mav in (2, 1, 3, 4)])
        plain = estimator.finish()
        same(found, plain)
        assert (found.innovations, found.innovations_inside) == (plain.innovations, plain.innovations_inside)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_in_whatever_order_data_comes_within_the_lag_the_belief_is_the_same(seed):
    """Every packet at any tick from its own to the last that it is of use in, some of them twice, some at once."""
    rng, ticks = np.random.default_rng(seed), flown(seed % 7, ticks=30)
    arrived = [[] for _ in ticks]
    for k, packets in enumerate(links.perfect(ticks, STATION)):
        for sent in packets:
            for when in rng.integers(k, min(k + LAG + 1, len(ticks)), size=1 + (rng.random() < 0.2)):
                arrived[when].append(sent)
    for packets in arrived:
        rng.shuffle(packets)
    same(last(ticks, arrived), last(ticks, links.perfect(ticks, STATION)), atol=1e-9)


@pytest.mark.parametrize("readings", [True, False])
@pytest.mark.parametrize("sets", [True, False])
def test_what_is_lost_is_lost_and_the_rest_is_the_same_in_whatever_order(readings, sets):
    rng, ticks = np.random.default_rng(1), flown(1)
    some = [
        [sent for sent in packets if rng.random() < 0.7 or not (readings if sent.odometry else sets)]
        for packets in links.perfect(ticks, STATION)
    ]
    some[0], some[-1] = (links.perfect(ticks, STATION)[k] for k in (0, -1))
    late = [[] for _ in ticks]
    for k, packets in enumerate(some):
        for sent in packets:
            # Where readings are lost, the next one must come while their ticks can be done again.
            late[min(k + int(rng.integers(LAG - 4)), len(ticks) - 1)].append(sent)
    same(last(ticks, late), last(ticks, some), atol=1e-9)


def test_repetitions_change_no_bit():
    ticks = flown(2)
    arrived = links.faulty(np.random.default_rng(2), ticks, STATION, delay=2, jitter=3)
    twice = [[*packets, *packets, *(arrived[k - 1] if k else [])] for k, packets in enumerate(arrived)]
    same(last(ticks, twice), last(ticks, arrived))


def test_what_comes_after_the_lag_changes_no_bit():
    ticks = flown(3)
    lost = links.faulty(np.random.default_rng(3), ticks, STATION, loss=0.3)
    back = [
        [sent for sent in packets if sent not in lost[k]] for k, packets in enumerate(links.perfect(ticks, STATION))
    ]
    too_late = [[*packets, *(back[k - LAG - 1] if k > LAG else [])] for k, packets in enumerate(lost)]
    same(last(ticks, too_late), last(ticks, lost))
    in_time = [[*packets, *(back[k - LAG] if k >= LAG else [])] for k, packets in enumerate(lost)]
    assert np.abs(last(ticks, in_time).poses - last(ticks, lost).poses).max() > 1e-6


def test_without_a_lag_nothing_late_is_of_use():
    ticks = flown(4)
    rng = np.random.default_rng(4)
    delayed = links.faulty(rng, ticks, STATION, delay=1, readings=False)
    own = links.faulty(rng, ticks, STATION, loss=1 - 1e-12, readings=False)
    same(last(ticks, delayed, config=AgentConfig(lag_s=0.0)), last(ticks, own, config=AgentConfig(lag_s=0.0)))


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_covariances_stay_symmetric_and_positive_whatever_is_lost_and_late(seed):
    rng, ticks = np.random.default_rng(seed), flown(seed % 5, ticks=50)
    arrived = links.faulty(
        rng,
        ticks,
        STATION,
        loss=rng.uniform(0, 0.9),
        delay=int(rng.integers(12)),
        jitter=int(rng.integers(6)),
        burst=int(rng.integers(20)),
    )
    history = surveyed(ticks)
    for _ in links.fly(history, ticks, arrived, STATION):
        state = history._estimator.snapshot().state
        P = state.P[~np.isclose(state.P.diagonal(), 0)][:, ~np.isclose(state.P.diagonal(), 0)]
        np.testing.assert_allclose(P, P.T, atol=1e-12)
        assert np.linalg.eigvalsh((P + P.T) / 2)[0] > -1e-12


def test_a_burst_of_old_packets_is_one_replay_and_does_no_harm():
    """A partition heals: what six peers said in the last seconds comes in one tick."""
    ticks = flown(7, mavs=7, ticks=80)
    cut, healed = 30, 60
    lost = links.faulty(np.random.default_rng(7), ticks, STATION, lost=lambda k, mav: cut <= k < healed)
    everything = [
        sent for k, packets in enumerate(links.perfect(ticks, STATION)) if cut <= k < healed for sent in packets
    ]
    burst = [[*packets, *(everything if k == healed else [])] for k, packets in enumerate(lost)]
    history = surveyed(ticks)
    done = []
    predict = history._estimator.predict_from
    history._estimator.predict_from = lambda *given: (done.append(1), predict(*given))
    beliefs = []
    for k, believed in enumerate(links.fly(history, ticks, burst, STATION)):
        assert len(done) <= LAG + 1
        assert (k == healed) == (len(done) > 1)
        done.clear()
        beliefs.append(believed)
    found = links.off(ticks, beliefs, STATION)
    assert np.linalg.norm(found.errors[healed + 1 :, :, :3], axis=2).max() < 0.25


def test_a_survey_takes_in_everybody_when_he_is_first_heard():
    ticks = flown(8, ticks=30)
    arrived = links.faulty(np.random.default_rng(8), ticks, STATION, lost=lambda k, mav: mav == 3 and k < 20)
    beliefs = list(links.fly(surveyed(ticks), ticks, arrived, STATION))
    assert (beliefs[19].states == LOCALISED).tolist() == [True, True, False, True]
    assert (beliefs[-1].states == LOCALISED).all()
    assert np.abs(links.off(ticks[-1:], beliefs[-1:], STATION).errors[..., :3]).max() < 0.25


@pytest.mark.parametrize("missed", [1, 5, LAG, 3 * LAG])
def test_ticks_without_its_own_data_are_bridged(missed):
    ticks = flown(9, ticks=60 + missed)
    history = surveyed(ticks)
    list(links.fly(history, ticks[:40], links.perfect(ticks, STATION)[:40], STATION))
    for k in range(40 + missed, len(ticks)):
        history.hear(k, ticks[k].odometry, [links.untold(ticks[k], mav) for mav in (2, 1, 3, 4)])
        history.estimate()
    found = links.off(ticks[-1:], [history.beliefs()], STATION)
    assert np.abs(found.errors[..., :3]).max() < 0.25
    assert (history.beliefs().states == LOCALISED).all()


@pytest.mark.parametrize("missed", [5, LAG, 3 * LAG, 300])
def test_what_came_late_before_a_gap_is_of_no_use_after_it(missed):
    """A process is stopped after it has heard something late, and before it has estimated that."""
    ticks = flown(10, ticks=45 + missed)
    history, deaf = surveyed(ticks), surveyed(ticks)
    for k in (*range(40), *range(40 + missed, len(ticks))):
        for one in (history, deaf):
            if one is history and k == 40 + missed:
                assert one.late(35, 1, odometry=ticks[35].odometry[1])
            heard = {mav: z for mav, z in ticks[k].odometry.items() if k >= 40 or k < 34 or mav != 1}
            one.hear(k, heard, [links.untold(ticks[k], mav) for mav in (2, 1, 3, 4) if mav in heard])
            assert one.begun_anew() == []
            one.estimate()
    assert np.linalg.eigvalsh(history.beliefs().covariances[0]).min() > 0
    if missed > LAG:
        same(history.beliefs(), deaf.beliefs())


def test_after_a_gap_without_end_it_begins_anew():
    ticks = flown(10)
    history = surveyed(ticks)
    list(links.fly(history, ticks, links.perfect(ticks, STATION), STATION))
    history.hear(10**9, ticks[-1].odometry, [])
    history.estimate()
    assert history.members == [STATION]


def moved(tick, mav, origin, there):
    return tick._replace(odometry=tick.odometry | {mav: compose(origin, relative_pose(there, tick.odometry[mav]))})


@pytest.mark.parametrize("delay", [0, 3])
def test_an_odometry_that_begins_anew_is_noticed_and_old_readings_of_it_are_not_taken_for_new(delay):
    ticks = flown(11)
    ticks = [
        moved(tick, 3, np.array([20.0, 0, 0, 1]), ticks[25].odometry[3]) if k >= 25 else tick
        for k, tick in enumerate(ticks)
    ]
    history, found = surveyed(ticks), {}
    for k, tick in enumerate(ticks):
        odometry = {STATION: tick.odometry[STATION]}
        for mav in (1, 3, 4):
            if not delay:
                odometry[mav] = tick.odometry[mav]
            elif k >= delay:
                history.late(k - delay, mav, odometry=ticks[k - delay].odometry[mav])
        history.hear(k, odometry, [])
        anew = history.begun_anew()
        if anew:
            found[k] = anew
            history.dismiss(anew, anew)
            assert not history.late(20, 3, odometry=ticks[20].odometry[3])
        history.estimate()
    assert found == {25 + delay: [3]}
    assert history.members == [1, 2, 4]


@pytest.mark.parametrize("ago", [0, 1, 4, LAG])
def test_who_is_admitted_in_the_past_was_there_since(ago):
    """As if he had been admitted then, and also if something of before comes later still."""
    ticks, when = flown(12), 25
    y, Sigma = np.zeros((MAVS + 1, 4)), np.eye(4 * MAVS + 4) * 1e-3
    true, own = team.frames_in(ticks[when].truth, STATION), ticks[when].odometry[STATION]
    y[:MAVS] = compose(np.tile(own, (MAVS, 1)), true)
    found = []
    for late in (0, ago):
        history = surveyed(ticks)
        arrived = links.perfect(ticks, STATION)
        missing = [sent for sent in arrived[when - 3] if sent.mav == 4]
        arrived[when - 3] = [sent for sent in arrived[when - 3] if sent.mav != 4]
        arrived[min(when + 2, len(ticks))] += missing
        beliefs = []
        for k, believed in enumerate(links.fly(history, ticks, arrived, STATION)):
            beliefs.append(believed)
            if k == 15:
                history.dismiss([1, 3], [])
            if k == when + late:
                history.admit(when, [1, 3], y, Sigma)
                assert history.members == [1, 2, 3, 4]
        found.append(beliefs[-1])
    same(*found, atol=1e-9)


def test_who_is_dismissed_stays_out_when_late_data_comes():
    ticks = flown(13)
    history = surveyed(ticks)
    arrived = links.faulty(np.random.default_rng(13), ticks, STATION, delay=2, jitter=3)
    beliefs = []
    for k, believed in enumerate(links.fly(history, ticks, arrived, STATION)):
        beliefs.append(believed)
        if k == 20:
            assert 3 in history.members
            history.dismiss([3], [])
        assert k < 20 or 3 not in history.members
        assert k < 20 or all(3 not in history.team(t).members for t in range(k - LAG + 1, k + 1))
    assert np.abs(links.off(ticks[-1:], beliefs[-1:], STATION).errors[:, [0, 2], :3]).max() < 0.25


def test_what_it_was_some_ticks_ago_is_known_for_the_lag():
    ticks = flown(14)
    history = surveyed(ticks)
    poses = [
        history.team(k).poses.y for k, _ in enumerate(links.fly(history, ticks, links.perfect(ticks, STATION), STATION))
    ]
    for ago in range(LAG + 1):
        np.testing.assert_array_equal(history.team(39 - ago).poses.y, poses[39 - ago])
    assert history.team(39 - LAG - 2) is None
    assert history.team(40) is None
