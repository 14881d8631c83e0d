"""A team that is what it is thought to be, and several that are not."""

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.interface.frames import compose
from agent.registration.bank import Filter, Team
from agent.registration.watchdog import EVERY, Watchdog
from tests.agent.registration.beginning import true_poses, wandering, window_of


def watchdog(mavs):
    return Watchdog(Filter(AgentConfig(), mavs, 10.0), mavs, 0.9)


def believed(rng, poses, placed=None):
    """Where everybody is thought to be: where he is, nearly."""
    mavs = len(poses)
    sigma = np.tile([0.03, 0.03, 0.03, 0.01], (mavs, 1))
    y = np.vstack([poses, np.zeros(4)])
    y[1:mavs] += rng.normal(0, sigma[1:])
    return Team(y, np.diag(sigma.ravel() ** 2), np.ones(mavs, bool) if placed is None else placed)


def alarms(ticks, spoil=None, since=0, placed=None, heard=lambda k, i: True):
    """Every alarm, with its tick; the team is not what it seems from one tick on."""
    rng, mavs = np.random.default_rng(0), len(ticks[0].truth)
    dog, found = watchdog(mavs), []
    for frame, tick in zip(window_of(ticks, length=len(ticks)).frames, ticks, strict=True):
        for i in range(mavs):
            if not heard(frame.tick, i):
                frame.heard[i], frame.spherical[i] = False, np.nan
        if frame.tick % EVERY == 0:
            poses = true_poses(tick)
            if spoil is not None and frame.tick >= since:
                poses = spoil(poses)
            wrong = dog.look(believed(rng, poses, placed), frame)
            if wrong:
                found.append((frame.tick - since, sorted(wrong)))
    return found


@pytest.mark.statistical
@pytest.mark.parametrize("seed", range(5))
def test_a_consistent_team_is_left_alone(seed):
    assert alarms(wandering([1, seed], 5, 300)) == []


@pytest.mark.statistical
@pytest.mark.parametrize("seed", range(2))
def test_lost_sets_are_nobodys_fault(seed):
    rng = np.random.default_rng([2, seed])
    assert alarms(wandering([2, seed], 5, 150), heard=lambda k, i: rng.random() < 0.6) == []


def exchanged(poses):
    return poses[[0, 1, 4, 3, 2, *range(5, len(poses))]]


def displaced(poses):
    """Upwards: along the line of sight 1 m is not much more than what a range is uncertain by."""
    return poses + [0, 0, 1, 0] * (np.arange(len(poses)) == 3)[:, None]


def turned(poses):
    return poses + [0, 0, 0, 0.3] * (np.arange(len(poses)) == 2)[:, None]


def station_turned(poses):
    """In its own frame everybody else stands elsewhere."""
    own = [*poses[0, :3], 0]
    turned = compose(np.tile([0, 0, 0, 0.3], (len(poses), 1)), poses - own) + own
    return np.vstack([poses[:1], turned[1:]])


FAULTS = pytest.mark.parametrize(
    ("spoil", "culprits"),
    [(exchanged, [2, 4]), (displaced, [3]), (turned, [2]), (station_turned, [0])],
    ids=["two exchanged", "one displaced", "one turned", "the station turned"],
)


def first_alarm(found, culprits):
    """When it came; the alarms that follow name everybody who is wrong, and none names anybody else."""
    assert set().union(*(wrong for _, wrong in found)) == set(culprits)
    return found[0][0]


@FAULTS
@pytest.mark.parametrize("seed", range(5))
def test_who_is_wrong_is_found_in_10_ticks_and_nobody_else(spoil, culprits, seed):
    assert first_alarm(alarms(wandering([3, seed], 7, 15), spoil), culprits) < 10


@FAULTS
@pytest.mark.parametrize("seed", range(3))
def test_who_goes_wrong_after_a_while_is_found_soon(spoil, culprits, seed):
    after = first_alarm(alarms(wandering([4, seed], 7, 75), spoil, since=51), culprits)
    assert 0 <= after < 20


@FAULTS
@pytest.mark.parametrize("seed", range(3))
def test_in_a_team_of_five_too(spoil, culprits, seed):
    assert first_alarm(alarms(wandering([5, seed], 5, 24), spoil), culprits) < 20


def lifted(poses):
    """Nobody can have seen him there."""
    return poses + [0, 0, 5, 0] * (np.arange(len(poses)) == 1)[:, None]


@pytest.mark.parametrize(
    "mavs",
    [
        pytest.param(2, marks=pytest.mark.xfail(strict=True, reason="two never see enough of one another to be sure")),
        3,
        4,
    ],
)
def test_in_a_small_team_whoever_is_far_off_is_found(mavs):
    """Not which of two, of course."""
    assert all(alarms(wandering([6, seed], mavs, 60), lifted) for seed in range(3))


def test_who_is_not_localised_is_not_watched():
    placed = np.arange(7) != 3
    assert alarms(wandering(7, 7, 60), displaced, placed=placed) == []


def test_once_forgotten_a_mav_is_judged_afresh():
    """He was wrong for 5 looks, and is right now."""
    ticks, later = wandering(8, 7, 30), []
    for forgiven in (False, True):
        dog, rng, found = watchdog(7), np.random.default_rng(8), []
        for frame, tick in zip(window_of(ticks).frames, ticks, strict=True):
            if frame.tick == 15 and forgiven:
                dog.forget([2])
            poses = true_poses(tick)
            wrong = dog.look(believed(rng, turned(poses) if frame.tick < 15 else poses), frame)
            found += wrong if frame.tick >= 15 else []
        later.append(set(found))
    assert later == [{2}, set()]


@pytest.mark.parametrize("mavs", [1, 2])
def test_however_small_a_team_may_be(mavs):
    ticks = wandering(9, 2, 30)
    alone = [tick._replace(truth=tick.truth[:mavs]) for tick in ticks]
    for tick in alone:
        for mav in range(mavs + 1, 3):
            tick.odometry.pop(mav), tick.sets.pop(mav)
    assert alarms(alone) == []
