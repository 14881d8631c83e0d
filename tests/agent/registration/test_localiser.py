"""One agent's estimation as a whole, from a start of which nothing is known, through whatever may go wrong."""

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.estimator.estimator import Estimator
from agent.estimator.joint_update import DetectionSet
from agent.interface.fleet import Fleet
from agent.interface.frames import compose, relative_pose, wrap
from agent.interface.messages import LOCALISED, SEARCHING
from agent.interface.sensors import Detector
from agent.localiser import Localiser
from tests import links, team
from tests.agent.registration.beginning import CONSISTENT, SEEDS, hovering, order, wandering


def fly(ticks, station=1, heard=lambda k, i: True, config=None, survey=False, delay=0):
    """What the agent of this station says, tick by tick."""
    mavs = len(ticks[0].truth)
    localiser = Localiser(config or AgentConfig(), Fleet(mavs=mavs), station)
    if survey:
        localiser.start(team.frames_in(ticks[0].truth, station), 0.2, 0.1)
    for k, tick in enumerate(ticks):
        ids = [i for i in order(mavs, station) if i == station or heard(k, i)]
        in_time = [i for i in ids if not delay or i == station]
        if k >= delay > 0:
            for i in ids[1:]:
                localiser.late(k - delay, i, spherical=ticks[k - delay].sets[i])
        yield localiser.tick(k, {i: tick.odometry[i] for i in ids}, [DetectionSet(i, tick.sets[i]) for i in in_time])


def errors(tick, found, station=1):
    """(N, 4) of everybody's pose relative to the station."""
    mavs = len(tick.truth)
    own, true = (np.tile(each[station - 1], (mavs, 1)) for each in (found.beliefs.poses, tick.truth))
    off = relative_pose(own, found.beliefs.poses) - relative_pose(true, tick.truth)
    off[:, 3] = wrap(off[:, 3])
    return off


def story(ticks, station=1, **how):
    """(T, N) who is called localised when; each of them must be where he is said to be."""
    states = []
    for tick, found in zip(ticks, fly(ticks, station, **how), strict=True):
        localised = found.beliefs.states == LOCALISED
        off = np.abs(errors(tick, found, station)[localised])
        assert off[:, :3].max() < 0.5
        assert off[:, 3].max() < 0.15
        assert (found.situation is None) == localised.all() or found.situation.reasons.count("") == localised.sum()
        states.append(localised)
    return np.array(states)


def restarted(ticks, mav, at, origin):
    """The same ticks, but that the odometry of one begins anew: its reading at that tick is `origin`."""
    there = ticks[at].odometry[mav]
    anew = [tick.odometry | {mav: compose(origin, relative_pose(there, tick.odometry[mav]))} for tick in ticks]
    return [tick if k < at else tick._replace(odometry=anew[k]) for k, tick in enumerate(ticks)]


FAR, NEAR = np.array([30.0, 0, 2, -1.5]), np.array([0.1, 0.1, 0.0, 0.6])


@pytest.mark.parametrize("make", [hovering, wandering])
@pytest.mark.parametrize("station", [1, 3])
def test_from_nothing_to_localised(make, station):
    localised = story(make(1, 5, 30), station)
    assert localised[0].tolist() == [mav == station for mav in range(1, 6)]
    assert localised[10:].all()


def test_what_it_says_is_in_the_order_of_numbers():
    first = next(fly(hovering(2, 4, 1), station=3))
    assert first.beliefs.states.tolist() == [SEARCHING, SEARCHING, LOCALISED, SEARCHING]
    assert first.situation.reasons[2] == ""
    assert all(first.situation.reasons[k] for k in (0, 1, 3))
    assert first.situation.states.tolist() == first.beliefs.states.tolist()
    assert (first.beliefs.covariances[[0, 1, 3], 0, 0] == 1e6).all()


def test_once_everybody_is_localised_there_is_nothing_to_explain():
    found = list(fly(hovering(3, 4, 20)))
    assert found[0].situation is not None
    assert found[-1].situation is None


def test_the_same_inputs_give_the_same_bits():
    one, other = (list(fly(wandering(4, 4, 15)))[-1].beliefs for _ in range(2))
    assert one.poses.tobytes() == other.poses.tobytes()
    assert one.covariances.tobytes() == other.covariances.tobytes()


@pytest.mark.parametrize("mavs", [1, 2])
def test_however_small_a_team_may_be(mavs):
    assert story(hovering(5, mavs, 40))[-1].all()


def test_a_surveyed_team_need_not_search():
    assert story(hovering(6, 4, 20), survey=True).all()


@pytest.mark.parametrize("make", [hovering, wandering])
def test_a_mav_whose_odometry_jumps_is_searched_at_once(make):
    localised = story(restarted(make(7, 5, 80), 3, 30, FAR))
    assert not localised[30, 2]
    assert localised[15:, [0, 1, 3, 4]].all()
    assert localised[45:, 2].all()


def unnoticed(ticks, station=1):
    """As `story`, of a restart that is no jump: until it is found out he is not where he is said to be."""
    found = list(fly(ticks, station))
    localised = np.array([each.beliefs.states == LOCALISED for each in found])
    return localised, np.array([errors(tick, each, station) for tick, each in zip(ticks, found, strict=True)])


@pytest.mark.parametrize(("make", "mavs"), [(wandering, 5), (hovering, 7)])
@pytest.mark.parametrize("seed", range(2))
def test_a_restart_that_is_no_jump_is_found_out_and_repaired_in_5_s(make, mavs, seed):
    """New origin and yaw, near enough to the old ones that the MAV might have flown there."""
    localised, off = unnoticed(restarted(make([8, seed], mavs, 82), 3, 30, NEAR))
    others = [k for k in range(mavs) if k != 2]
    assert localised[15:, others].all()
    assert not localised[30:80, 2].all()
    assert localised[80:, 2].all()
    assert np.abs(off[-1]).max() < 0.15
    assert np.abs(off[15:, others]).max() < 0.3


@pytest.mark.parametrize(
    "mavs",
    [pytest.param(2, marks=pytest.mark.xfail(strict=True, reason="two see too little of one another to be sure")), 3],
)
def test_in_a_small_team_too(mavs):
    _, off = unnoticed(restarted(hovering(9, mavs, 82), 2, 30, NEAR))
    assert np.abs(off[-1]).max() < 0.15


@pytest.mark.parametrize("origin", [FAR, NEAR])
def test_a_station_that_begins_anew_forgets_everybody_and_finds_them_again(origin):
    localised, off = unnoticed(restarted(hovering(10, 5, 82), 1, 30, origin))
    assert localised[:, 0].all()
    assert not localised[30:80, 1:].all()
    assert localised[80:].all()
    assert np.abs(off[-1]).max() < 0.15


def test_a_late_joiner_comes_in_when_he_is_heard():
    localised = story(hovering(11, 5, 80), heard=lambda k, i: i != 3 or k >= 40)
    assert localised[20:, [0, 1, 3, 4]].all()
    assert not localised[:40, 2].any()
    assert localised[60:, 2].all()


def test_while_one_is_silent_another_that_jumps_is_found_again():
    localised = story(restarted(hovering(12, 5, 70), 3, 40, FAR), heard=lambda k, i: i != 4 or k < 20)
    assert localised[60:, [0, 1, 2, 4]].all()


def test_who_is_silent_for_a_while_needs_no_search():
    localised = story(wandering(13, 5, 60), heard=lambda k, i: i != 4 or not 20 <= k < 25)
    assert localised[10:, [0, 1, 2, 4]].all()
    assert localised[30:].all()


def test_who_is_silent_for_long_is_not_called_localised_and_the_reason_is_given():
    found = list(fly(wandering(18, 5, 40), heard=lambda k, i: i != 4 or k < 20))[-1]
    assert found.beliefs.states.tolist() == [LOCALISED, LOCALISED, LOCALISED, SEARCHING, LOCALISED]
    assert found.situation.reasons[3].startswith("not heard for 2.0 s, known to 0.")
    assert found.situation.reasons[3].endswith(" rad only, 0.15 m and 0.05 rad are needed")


@pytest.mark.parametrize("origin", [FAR, NEAR])
def test_who_begins_anew_while_he_is_silent_is_searched(origin):
    ticks = restarted(hovering(19, 5, 70), 4, 25, origin)
    *_, last = fly(ticks, heard=lambda k, i: i != 4 or not 20 <= k < 30)
    assert (last.beliefs.states == LOCALISED).all()
    assert np.abs(errors(ticks[-1], last)).max() < 0.15


def test_sets_that_are_too_late_for_the_filter_are_good_for_the_search():
    ticks = hovering(14, 5, 20)
    found = list(fly(ticks, delay=2))
    when = next(k for k, each in enumerate(found) if (each.beliefs.states == LOCALISED).all())
    assert np.abs(errors(ticks[when], found[when])).max() < 0.3


@pytest.mark.parametrize("seed", range(3))
def test_three_packets_in_ten_may_be_lost(seed):
    lost = np.random.default_rng([15, seed]).random((40, 6)) < 0.3
    localised = story(wandering([15, seed], 5, 40), heard=lambda k, i: not lost[k, i])
    assert localised[20:].any(axis=0).all()


def heard_late(ticks, station, network, seed=0, localiser=None):
    """What the agent of this station says over a bad network, tick by tick."""
    localiser = localiser or Localiser(AgentConfig(), Fleet(mavs=len(ticks[0].truth)), station)
    arrived = links.faulty(np.random.default_rng([99, seed]), ticks, station, **network)
    for k, (tick, packets) in enumerate(zip(ticks, arrived, strict=True)):
        odometry, sets = {station: tick.odometry[station]}, [links.untold(tick, station)]
        for sent in packets:
            of = ticks[sent.tick]
            if sent.tick < k and sent.odometry:
                localiser.late(sent.tick, sent.mav, odometry=of.odometry[sent.mav])
            elif sent.tick < k:
                localiser.late(sent.tick, sent.mav, spherical=of.sets[sent.mav])
            elif sent.odometry:
                odometry[sent.mav] = of.odometry[sent.mav]
            else:
                sets.append(links.untold(of, sent.mav))
        yield localiser.tick(k, odometry, sorted(sets, key=lambda one: (one.station != station, one.station)))


NETWORKS = {
    "100 ms late": {"delay": 1},
    "sets lost and late": {"loss": 0.3, "delay": 1, "readings": False},
    "readings lost and late": {"loss": 0.3, "delay": 1, "sets": False},
    "lost, late, out of order": {"loss": 0.3, "delay": 2, "jitter": 1},
    "500 ms late": {"delay": 5},
}


@pytest.mark.parametrize("network", NETWORKS.values(), ids=NETWORKS)
@pytest.mark.parametrize(("make", "seed"), [(hovering, 0), (wandering, 1), (hovering, 2)])
def test_over_a_bad_network_a_team_is_localised_in_2500_ms_and_stays_so(network, make, seed):
    ticks = make([20, seed], 7, 60)
    station = 1 + 2 * seed
    found = list(heard_late(ticks, station, network, seed))
    localised = np.array([each.beliefs.states == LOCALISED for each in found])
    assert localised[25:].all()
    off = np.array([np.abs(errors(tick, each, station)) for tick, each in zip(ticks, found, strict=True)])
    assert off[localised][:, :3].max() < 0.5
    assert off[localised][:, 3].max() < 0.15
    assert np.sqrt((off[35:, :, :3] ** 2).sum(2).mean()) < 0.12


def test_with_half_lost_in_bursts_it_takes_longer():
    ticks = wandering(21, 5, 90)
    found = list(heard_late(ticks, 2, {"loss": 0.5, "burst": 8}, 1))
    localised = np.array([each.beliefs.states == LOCALISED for each in found])
    assert localised.any(axis=0).all()
    for tick, each, known in zip(ticks, found, localised, strict=True):
        assert np.abs(errors(tick, each, 2)[known][:, :3]).max() < 0.5


@pytest.mark.parametrize("network", [*NETWORKS.values(), {"loss": 0.5, "burst": 10}], ids=[*NETWORKS, "bursts"])
def test_what_is_late_or_lost_is_no_wrong_identity(network, monkeypatch):
    dismissed = []
    monkeypatch.setattr(Localiser, "_dismiss", lambda self, mavs, anew: dismissed.append(mavs))
    ticks = wandering(22, 5, 120)
    list(heard_late(ticks, 1, network))
    assert dismissed == []


@pytest.mark.parametrize("delay", [0, 3, 5])
def test_a_restart_is_noticed_and_repaired_however_late_its_data(delay):
    ticks = restarted(hovering(23, 5, 90), 3, 30, FAR)
    found = list(heard_late(ticks, 1, {"delay": delay}))
    localised = np.array([each.beliefs.states == LOCALISED for each in found])
    assert localised[29 + delay].all()
    assert not localised[30 + delay, 2]
    assert localised[30 + delay, [0, 1, 3, 4]].all()
    assert localised[60:].all()
    assert np.abs(errors(ticks[-1], found[-1])).max() < 0.3


def nees_when_admitted(seed, network, mavs=5):
    """Per dimension, mean over those taken in, in the tick of the commit; after all data has come."""
    ticks, station = wandering([24, seed], mavs, 40), 1
    localiser = Localiser(AgentConfig(), Fleet(mavs=mavs), station)
    commits = []
    admit = localiser._history.admit
    localiser._history.admit = lambda tick, mavs, y, Sigma: (
        commits.append((tick, mavs, y, Sigma)),
        admit(tick, mavs, y, Sigma),
    )
    next(None for _ in heard_late(ticks, station, network, seed, localiser) if commits)
    tick, newcomers, y, Sigma = commits[0]
    own, truth = ticks[tick].odometry[station], ticks[tick].truth
    true = compose(np.tile(own, (mavs, 1)), relative_pose(np.tile(truth[station - 1], (mavs, 1)), truth))
    values = []
    for mav in newcomers:
        e, rows = y[mav - 1] - true[mav - 1], slice(4 * mav - 4, 4 * mav)
        e[3] = wrap(e[3])
        values.append(e @ np.linalg.solve(Sigma[rows, rows], e) / 4)
    return float(np.mean(values))


@pytest.mark.statistical
@pytest.mark.parametrize("network", [NETWORKS["lost, late, out of order"], NETWORKS["500 ms late"]])
def test_over_a_bad_network_too_it_begins_as_sure_as_it_may_be(network):
    """Two-sided 99 % of chi-square with 12 teams of 16 dimensions: 0.75 .. 1.28."""
    assert 0.75 < np.mean([nees_when_admitted(seed, network) for seed in range(12)]) < 1.28


def nees(seed, config=None, mavs=4):
    """Per dimension, of everybody in the tick in which the last is localised."""
    ticks = hovering([16, seed], mavs, 40)
    for tick, found in zip(ticks, fly(ticks, config=config), strict=True):
        if (found.beliefs.states == LOCALISED).all():
            off = errors(tick, found)[1:]
            yaw = found.beliefs.poses[0, 3]
            turn = np.eye(4)
            turn[:2, :2] = [[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]
            covariances = turn @ found.beliefs.covariances[1:] @ turn.T
            return float(np.mean([e @ np.linalg.solve(C, e) / 4 for e, C in zip(off, covariances, strict=True)]))
    raise AssertionError("never localised")


@pytest.mark.statistical
def test_the_filter_begins_as_sure_as_it_may_be():
    assert CONSISTENT[0] < np.mean([nees(seed) for seed in range(SEEDS)]) < CONSISTENT[1]


@pytest.mark.statistical
def test_who_believes_in_sharper_eyes_is_outside_the_band():
    sharper = Detector(bearing_sigma_rad=0.006, range_sigma_slope=0.037, range_sigma_offset_m=0.025)
    assert np.mean([nees(seed, AgentConfig(detector=sharper)) for seed in range(SEEDS)]) > CONSISTENT[1]


def test_a_survey_is_used_as_before():
    """As the filter alone would."""
    ticks = wandering(17, 4, 20)
    *_, found = fly(ticks, survey=True)
    estimator = Estimator(AgentConfig(), Fleet(mavs=4), 1)
    estimator.start(team.frames_in(ticks[0].truth, 1), 0.2, 0.1)
    for tick in ticks:
        estimator.predict(tick.odometry)
        estimator.associate_all([DetectionSet(i, tick.sets[i]) for i in range(1, 5)])
        beliefs = estimator.finish()
    np.testing.assert_array_equal(found.beliefs.poses, beliefs.poses)
    np.testing.assert_array_equal(found.beliefs.covariances, beliefs.covariances)
