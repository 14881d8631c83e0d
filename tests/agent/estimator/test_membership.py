"""Newcomers of a filter that flies already, and those who leave it, against plain Gaussian algebra."""

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.estimator.estimator import Estimator
from agent.estimator.joint_update import DetectionSet
from agent.estimator.membership import conditional, with_newcomers
from agent.estimator.moments import pose_moments
from agent.estimator.state import P_FRAME, P_ODOM, PSI, PSI_FRAME, State
from agent.interface.fleet import Fleet
from agent.interface.frames import relative_pose, rotate_z, wrap
from agent.interface.messages import LOCALISED, SEARCHING
from tests import team

MAVS = 4
SIGMA = (0.1, 0.1, 0.1, 0.02)  # of a pose in what is handed over


def entries(rows):
    return [4 * row + k for row in rows for k in range(4)]


def random_joint(rng, bodies, sigma=SIGMA):
    """Mean (B, 4) and covariance (4B, 4B) of any poses."""
    y = np.column_stack([rng.normal(size=(bodies, 3)) * 3, rng.uniform(-3, 3, bodies)])
    root = rng.normal(size=(4 * bodies, 8 * bodies)) / np.sqrt(8 * bodies) * np.tile(sigma, bodies)[:, None]
    return y, root @ root.T


def lone(rng, station, ticks=3):
    """An estimator that knows of nobody, after some ticks of which it heard everybody's odometry."""
    estimator = Estimator(AgentConfig(), Fleet(mavs=MAVS), station)
    for _ in range(ticks):
        readings = np.column_stack([rng.normal(size=(MAVS, 3)), rng.uniform(-3, 3, MAVS)])
        estimator.predict({i + 1: readings[i] for i in range(MAVS)})
        estimator.finish()
    return estimator


def flown(seed, station=1, mavs=MAVS, ticks=15):
    """An estimator of a whole team after some ticks, and the last of these."""
    estimator = Estimator(AgentConfig(), Fleet(mavs=mavs), station)
    for k, tick in enumerate(team.circling(np.random.default_rng(seed), mavs, ticks)):
        if k == 0:
            estimator.start(team.frames_in(tick.truth, station), 0.05, 0.02)
        fed(estimator, tick)
    return estimator, tick


def fed(estimator, tick):
    estimator.predict(tick.odometry)
    estimator.associate_all([DetectionSet(i, s) for i, s in tick.sets.items()])
    return estimator.finish()


def moved(tick):
    """The same, but for what the odometry of each says."""
    return tick._replace(odometry={i: z + np.array([0.1, 0.05 * i, 0, 0.1]) for i, z in tick.odometry.items()})


def poses_of(estimator, mavs):
    """What it says of these MAVs' poses and, last, of the start: (B, 4) and (4B, 4B)."""
    at = entries([*(estimator.members.index(mav) for mav in mavs), len(estimator.members)])
    return estimator.poses.y[at].reshape(-1, 4), estimator.poses.Sigma[np.ix_(at, at)]


@pytest.mark.parametrize("station", [1, 3])
@pytest.mark.parametrize("seed", range(5))
def test_a_lone_station_that_admits_everybody_believes_what_it_is_given(seed, station):
    rng = np.random.default_rng([1, seed])
    estimator = lone(rng, station)
    y, Sigma = random_joint(rng, MAVS + 1)
    start, Sigma_start = poses_of(estimator, [])
    # What is given agrees with what is known of the start.
    others = [mav for mav in range(1, MAVS + 1) if mav != station]
    rows, last = entries([mav - 1 for mav in others]), entries([MAVS])
    A = rng.normal(size=(len(rows), 4)) * 0.5
    y[MAVS] = start[0]
    Sigma[np.ix_(last, last)] = Sigma_start
    Sigma[np.ix_(rows, last)] = A @ Sigma_start
    Sigma[np.ix_(last, rows)] = Sigma_start @ A.T
    estimator.admit(others, y, Sigma)
    assert estimator.members == list(range(1, MAVS + 1))
    found, covariance = poses_of(estimator, others)
    given = [mav - 1 for mav in others] + [MAVS]
    np.testing.assert_allclose(found[:, :3], y[given, :3], atol=1e-9)
    np.testing.assert_allclose(wrap(found[:, 3] - y[given, 3]), 0, atol=1e-9)
    np.testing.assert_allclose(covariance, Sigma[np.ix_(entries(given), entries(given))], atol=1e-10)


def told_of_more(seed, newcomers=(2,)):
    """An estimator of a team without some, a joint of everybody from elsewhere, and what follows from both."""
    rng = np.random.default_rng([2, seed])
    estimator, _ = flown([2, seed])
    whole, _ = poses_of(estimator, range(1, MAVS + 1))
    estimator.dismiss(list(newcomers))
    _, Sigma = random_joint(rng, MAVS + 1, sigma=(0.05, 0.05, 0.05, 0.02))
    y = whole + rng.normal(0, 0.02, (MAVS + 1, 4))
    new = [mav - 1 for mav in newcomers]
    old = [*(mav - 1 for mav in range(1, MAVS + 1) if mav not in (1, *newcomers)), MAVS]
    known = [row + 1 for row in old[:-1]]
    mean, covariance = poses_of(estimator, known)
    # p(new | old) of the joint times what the estimator believes of the old, in information form
    of = [*entries(new), *entries(old)]
    information, n = np.linalg.inv(Sigma[np.ix_(of, of)]), 4 * len(new)
    cross = information[:n, n:]
    joint = np.block(
        [
            [information[:n, :n], cross],
            [cross.T, cross.T @ np.linalg.solve(information[:n, :n], cross) + np.linalg.inv(covariance)],
        ]
    )
    difference = mean - y[old]
    difference[:, 3] = wrap(difference[:, 3])
    shift = -np.linalg.solve(information[:n, :n], cross @ difference.ravel())
    return estimator, (y, Sigma), known, y[new] + shift.reshape(-1, 4), np.linalg.inv(joint)


@pytest.mark.parametrize("newcomers", [(2,), (3, 4), (2, 4)])
@pytest.mark.parametrize("seed", range(4))
def test_newcomers_come_in_given_the_members_and_leave_these_alone(seed, newcomers):
    estimator, given, known, mean, covariance = told_of_more(seed, newcomers)
    before = poses_of(estimator, [1, *known])
    estimator.admit(list(newcomers), *given)
    assert estimator.members == list(range(1, MAVS + 1))
    for one, other in zip(before, poses_of(estimator, [1, *known]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-15)
    found, Sigma = poses_of(estimator, [*newcomers, *known])
    np.testing.assert_allclose(found[: len(newcomers), :3], mean[:, :3], atol=1e-9)
    np.testing.assert_allclose(wrap(found[: len(newcomers), 3] - mean[:, 3]), 0, atol=1e-9)
    np.testing.assert_allclose(Sigma, covariance, atol=1e-10)
    assert np.linalg.eigvalsh(Sigma).min() > 0


def test_full_turns_in_what_is_given_do_not_matter():
    found = []
    for turns in (0, 1):
        estimator, (y, Sigma), _, _, _ = told_of_more(7)
        y[[0, 2, 3], 3] += 2 * np.pi * turns
        estimator.admit([2], y, Sigma)
        found.append(estimator.poses)
    np.testing.assert_allclose(found[0].y, found[1].y, atol=1e-9)


def test_what_is_given_of_nobody_concerned_is_not_looked_at():
    found = []
    for spoilt in (0.0, np.nan):
        estimator, (y, Sigma), _, _, _ = told_of_more(8, newcomers=(2, 3))
        y[2] += spoilt
        Sigma[8:12] += spoilt
        Sigma[:, 8:12] += spoilt
        estimator.admit([2], y, Sigma)
        found.append(estimator.poses)
        assert estimator.members == [1, 2, 4]
        assert estimator.beliefs().states.tolist() == [LOCALISED, LOCALISED, SEARCHING, LOCALISED]
    np.testing.assert_array_equal(found[0].Sigma, found[1].Sigma)


@pytest.mark.statistical
def test_all_covariances_of_the_state_agree_with_monte_carlo():
    """Two members and the start, two newcomers: draws of the state, of the newcomers given it, of their readings."""
    rng = np.random.default_rng(3)
    x = np.column_stack([rng.normal(size=(3, 3)) * 2, rng.uniform(-3, 3, 3)] * 2).ravel()
    root = rng.normal(size=(24, 24)) / np.sqrt(24) * np.tile([0.01] * 3 + [0.003], 6)[:, None]
    state = State(x, root @ root.T, station=1)
    poses = pose_moments(state).poses
    y, Sigma = random_joint(rng, 4, sigma=(0.02, 0.02, 0.02, 0.005))  # newcomers, then the old but for the station
    y[2:] = poses.by_body[1:]
    joint = conditional(y, Sigma, [0, 1], [2, 3])
    readings = np.column_stack([rng.normal(size=(2, 3)) * 3, rng.uniform(-3, 3, 2)])
    sigma = (0.01, 0.004)
    made = with_newcomers(state, poses, [1, 2], joint, readings, sigma)

    n = 200_000
    draws = rng.multivariate_normal(state.x, state.P, n).reshape(n, 3, 8)
    arms = rotate_z(draws[:, 1:, PSI_FRAME], draws[:, 1:, P_ODOM]) + draws[:, 1:, P_FRAME]
    old = np.concatenate([arms, draws[:, 1:, PSI, None]], axis=2).reshape(n, 8)
    new = joint.mean + (old - joint.old_mean) @ joint.A.T + rng.multivariate_normal(np.zeros(8), joint.C, n)
    new = new.reshape(n, 2, 4)
    read = readings + rng.normal(size=(n, 2, 4)) * np.array([sigma[0]] * 3 + [sigma[1]])
    theirs = np.empty((n, 2, 8))
    theirs[..., P_ODOM], theirs[..., PSI] = read[..., :3], new[..., 3]
    theirs[..., PSI_FRAME] = new[..., 3] - read[..., 3]
    theirs[..., P_FRAME] = new[..., :3] - rotate_z(theirs[..., PSI_FRAME], read[..., :3])
    sampled = np.concatenate([draws, theirs], axis=1).reshape(n, 40)
    scale = np.sqrt(made.P.diagonal())
    np.testing.assert_allclose((sampled.mean(0) - made.x) / scale, 0, atol=0.02)
    np.testing.assert_allclose(np.cov(sampled.T) / np.outer(scale, scale), made.P / np.outer(scale, scale), atol=0.02)


@pytest.mark.parametrize("gone", [[3], [2, 4]])
def test_without_those_who_left_the_rest_is_the_marginal(gone):
    estimator, _ = flown(4)
    stay = [mav for mav in range(1, MAVS + 1) if mav not in gone]
    before = poses_of(estimator, stay)
    estimator.dismiss(gone)
    assert estimator.members == stay
    for one, other in zip(before, poses_of(estimator, stay), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)  # but for how the tick's update is linearised
    assert estimator.beliefs().states[gone[0] - 1] == SEARCHING


def test_who_left_is_not_missed_as_long_as_nothing_is_seen():
    """Both move by odometry alone: that of those who left touches nobody else."""
    whole, tick = flown(5)
    part, _ = flown(5)
    part.dismiss([3])
    for _ in range(3):
        tick = moved(tick)
        for estimator in (whole, part):
            estimator.predict(tick.odometry)
            estimator.finish()
    for one, other in zip(poses_of(whole, [1, 2, 4]), poses_of(part, [1, 2, 4]), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_who_leaves_and_is_admitted_as_he_was_was_never_away():
    whole, tick = flown(6)
    part, _ = flown(6)
    y, Sigma = poses_of(whole, range(1, MAVS + 1))
    part.dismiss([2, 3])
    part.admit([3, 2], y, Sigma)
    later = moved(tick).odometry
    for estimator in (whole, part):
        estimator.predict(later)
        estimator.finish()
    for one, other in zip(poses_of(whole, range(1, 5)), poses_of(part, range(1, 5)), strict=True):
        np.testing.assert_allclose(one, other, atol=3e-4)  # his own odometry's errors are new


def test_a_station_that_dismisses_everybody_is_alone_and_can_begin_anew():
    estimator, tick = flown(7)
    y, Sigma = poses_of(estimator, range(1, MAVS + 1))
    estimator.dismiss([2, 3, 4])
    assert estimator.members == [1]
    assert estimator.beliefs().states.tolist() == [LOCALISED, SEARCHING, SEARCHING, SEARCHING]
    assert (estimator.beliefs().covariances[1:, 0, 0] == 1e6).all()
    fed(estimator, tick)  # the same readings again: nobody has moved
    estimator.admit([2, 3, 4], y, Sigma)
    found, _ = poses_of(estimator, range(1, MAVS + 1))
    np.testing.assert_allclose(found, y, atol=0.02)
    assert (estimator.beliefs().states == LOCALISED).all()


def test_what_is_seen_of_strangers_is_clutter():
    """With and without the set of one who left, and whatever he sees."""
    found = []
    for silent in (False, True):
        estimator, tick = flown(8)
        estimator.dismiss([3])
        if silent:
            tick = tick._replace(sets={i: s for i, s in tick.sets.items() if i != 3})
        found.append(fed(estimator, tick))
    np.testing.assert_array_equal(found[0].poses, found[1].poses)
    np.testing.assert_array_equal(found[0].covariances, found[1].covariances)


@pytest.mark.parametrize("station", [1, 3])
def test_an_admitted_team_flies_on(station):
    """Admitted with the truth, roughly known, and tracked from then on."""
    rng = np.random.default_rng(9)
    estimator = Estimator(AgentConfig(), Fleet(mavs=MAVS), station)
    for k, tick in enumerate(team.circling(rng, MAVS, 60)):
        beliefs = fed(estimator, tick)
        if k == 10:
            true = team.frames_in(tick.truth, station)
            own = beliefs.poses[station - 1]
            y = np.zeros((MAVS + 1, 4))
            y[:MAVS, :3] = own[:3] + rotate_z(own[3], true[:, :3])
            y[:MAVS, 3] = own[3] + true[:, 3]
            y[:MAVS] += rng.normal(0, [0.1, 0.1, 0.1, 0.03], (MAVS, 4))
            Sigma = np.diag(np.tile([0.01, 0.01, 0.01, 0.001], MAVS + 1))
            y[MAVS] = beliefs.start
            estimator.admit([mav for mav in range(1, MAVS + 1) if mav != station], y, Sigma)
    own = np.tile(beliefs.poses[station - 1], (MAVS, 1))
    error = relative_pose(own, beliefs.poses) - relative_pose(np.tile(tick.truth[station - 1], (MAVS, 1)), tick.truth)
    assert (beliefs.states == LOCALISED).all()
    assert np.abs(error[:, :3]).max() < 0.15
    assert np.abs(wrap(error[:, 3])).max() < 0.03
