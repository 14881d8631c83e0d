"""The filter as a whole, on a small simulated team."""

import msgspec
import numpy as np
import pytest

from agent.config import AgentConfig, Filter
from agent.estimator.estimator import Estimator
from agent.estimator.joint_update import DetectionSet
from agent.interface.fleet import Fleet
from agent.interface.frames import relative_pose, wrap
from agent.interface.messages import LOCALISED, SEARCHING
from agent.interface.sensors import Odometry
from tests import links, team


def fly(
    seed,
    mavs=4,
    ticks=80,
    station=1,
    config=None,
    clairvoyant=False,
    far_m=0.0,
    at_once=False,
    true_odometry=None,
    drop=lambda k, i: False,
):
    """Errors (ticks, N - 1, 4) of relative poses and their covariances, as agent `station` believes them."""
    rng = np.random.default_rng(seed)
    estimator = Estimator(config or AgentConfig(), Fleet(mavs=mavs), station)
    errors, covariances, beliefs = [], [], None
    others = [j for j in range(mavs) if j != station - 1]
    for k, tick in enumerate(team.circling(rng, mavs, ticks, far_m=far_m)):
        if k == 0:
            noise = np.column_stack([rng.normal(0, 0.2, (mavs, 3)), rng.normal(0, 0.1, mavs)])
            noise[station - 1] = 0
            estimator.start(team.frames_in(tick.truth, station) + noise, 0.2, 0.1)
        estimator.predict({i: z for i, z in tick.odometry.items() if not drop(k, i)})
        heard = [i for i in [station, *(j + 1 for j in others)] if not drop(k, i)]
        sets = [DetectionSet(i, tick.sets[i], tick.labels[i] if clairvoyant else None) for i in heard]
        if at_once:
            estimator.associate_all(sets)
        else:
            for one in sets:
                estimator.associate(*one)
        beliefs = estimator.finish()
        own = np.tile(beliefs.poses[station - 1], (mavs, 1))
        true = relative_pose(np.tile(tick.truth[station - 1], (mavs, 1)), tick.truth)
        error = relative_pose(own, beliefs.poses) - true
        error[:, 3] = wrap(error[:, 3])
        turn = np.eye(4)
        c, s = np.cos(beliefs.poses[station - 1, 3]), np.sin(beliefs.poses[station - 1, 3])
        turn[:2, :2] = [[c, s], [-s, c]]
        errors.append(error[others])
        covariances.append(turn @ beliefs.covariances[others] @ turn.T)
    return np.array(errors), np.array(covariances), beliefs


def anees(errors, covariances, after=20):
    e = errors[after:, :, :, None]
    return float((e.swapaxes(2, 3) @ np.linalg.inv(covariances[after:]) @ e).mean() / 4)


def rms(errors, after=20):
    return float(np.sqrt((errors[after:, :, :3] ** 2).sum(2).mean()))


BAND = (0.83, 1.19)  # two-sided 95 % of chi-square with 20 runs x 12 dimensions, per dimension: 0.829 .. 1.187


@pytest.mark.statistical
@pytest.mark.parametrize("far_m", [0.0, 20.0])
def test_it_is_consistent(far_m):
    values = [anees(*fly([7, seed], far_m=far_m)[:2]) for seed in range(20)]
    assert BAND[0] < np.mean(values) < BAND[1]


@pytest.mark.statistical
def test_an_overconfident_filter_is_outside_the_band():
    believes_half = AgentConfig(odometry=Odometry(position_sigma_m=0.005, yaw_sigma_rad=0.001))
    values = [anees(*fly([7, seed], config=believes_half)[:2]) for seed in range(8)]
    assert np.mean(values) > BAND[1]


@pytest.mark.statistical
def test_anonymity_costs_little():
    ours = np.mean([rms(fly([8, seed])[0]) for seed in range(8)])
    told = np.mean([rms(fly([8, seed], clairvoyant=True)[0]) for seed in range(8)])
    assert ours < 1.1 * told


def test_every_station_believes_the_same():
    one, three = fly(3, station=1)[2], fly(3, station=3)[2]
    # not to the last digit: each has its own prior and its own gauge
    between = [relative_pose(b.poses[0], b.poses[1]) for b in (one, three)]
    np.testing.assert_allclose(between[0], between[1], atol=0.1)


@pytest.mark.statistical
def test_absolute_poses_profit_from_everybodys_odometry():
    """Of where it began, a station knows more than its own odometry tells it."""
    ours, naive = [], []
    for seed in range(12):
        rng = np.random.default_rng([9, seed])
        estimator = Estimator(AgentConfig(), Fleet(mavs=5), 1)
        for k, tick in enumerate(team.circling(rng, 5, 150)):
            if k == 0:
                first = tick.truth
                estimator.start(team.frames_in(first, 1), 0.2, 0.1)
            estimator.predict(tick.odometry)
            estimator.associate_all([links.untold(tick, mav) for mav in tick.sets])
            beliefs = estimator.finish()
        true = relative_pose(first[0], tick.truth[0])
        ours.append(np.sum((relative_pose(beliefs.start, beliefs.poses[0]) - true)[:3] ** 2))
        naive.append(np.sum((tick.odometry[1] - true)[:3] ** 2))
    assert np.sqrt(np.mean(ours)) < 0.7 * np.sqrt(np.mean(naive))


def test_gating_and_evaluation_switched_off_give_nearly_the_same():
    full = msgspec.structs.replace(AgentConfig(), filter=Filter(gating=False, hypothesis_evaluation=False))
    fast, plain = fly(4, ticks=15)[2], fly(4, ticks=15, config=full)[2]
    np.testing.assert_allclose(fast.poses, plain.poses, atol=2e-4)


def test_nobody_is_localised_before_the_start_and_all_are_after():
    estimator = Estimator(AgentConfig(), Fleet(mavs=3), 2)
    estimator.predict({1: np.zeros(4), 2: np.zeros(4), 3: np.zeros(4)})
    estimator.associate(1, np.array([[2.0, 0.1, 0.0]]))
    assert estimator.finish().states.tolist() == [SEARCHING, LOCALISED, SEARCHING]
    assert (fly(5)[2].states == LOCALISED).all()


def test_it_starts_only_when_every_odometry_is_there():
    estimator = Estimator(AgentConfig(), Fleet(mavs=2), 1)
    estimator.start(np.array([[0.0, 0, 0, 0], [2.0, 0, 0, 0]]), 0.2, 0.1)
    estimator.predict({1: np.zeros(4)})
    assert estimator.finish().covariances[1, 0, 0] == 1e6
    estimator.predict({1: np.zeros(4), 2: np.zeros(4)})
    assert estimator.finish().covariances[1, 0, 0] == pytest.approx(0.04, rel=1e-3)


def test_a_silent_mav_grows_uncertain_and_comes_back():
    errors, covariances, _ = fly(6, drop=lambda k, i: i == 3 and 30 <= k < 50)
    sigma = np.sqrt(np.trace(covariances[:, 1, :3, :3], axis1=1, axis2=2))
    yaw_sigma = np.sqrt(covariances[:, 1, 3, 3])
    assert yaw_sigma[49] > 5 * yaw_sigma[29]
    assert sigma[49] > sigma[29]
    assert sigma[55] < 1.2 * sigma[29]
    assert np.abs(errors[50:, 1, :3]).max() < 0.15


def test_a_single_mav_is_a_team():
    estimator = Estimator(AgentConfig(), Fleet(mavs=1), 1)
    estimator.start(np.zeros((1, 4)), 0.2, 0.1)
    estimator.predict({1: np.array([1.0, 2.0, 3.0, 0.5])})
    estimator.associate(1, np.array([[2.0, 0.1, 0.0]]))
    np.testing.assert_allclose(estimator.finish().poses, [[1.0, 2.0, 3.0, 0.5]])
