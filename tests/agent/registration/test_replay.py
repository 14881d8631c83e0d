"""New hypotheses that catch up, against those that were there all the time."""

from itertools import pairwise

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.interface.frames import relative_pose
from agent.registration import replay
from agent.registration.bank import Filter, Team, begin
from agent.registration.hypotheses import Hypotheses
from tests.agent.registration.beginning import (
    alone,
    exact,
    finished,
    heard,
    placement,
    true_poses,
    wandering,
    window_of,
)

MAVS = 4


class Start:
    """A station that knows nobody, after some ticks, and some hypotheses of it."""

    def __init__(self, seed, ticks=replay.TICKS, drop=lambda k, i: False):
        flown = wandering(seed, MAVS, ticks)
        self.window = window_of(flown)
        for frame in self.window.frames:
            for i in range(MAVS):
                if drop(frame.tick, i):
                    frame.heard[i], frame.spherical[i] = False, np.nan
        self.first, self.newest = self.window.frames[0], self.window.frames[-1]
        self.truth = [true_poses(tick) for tick in flown]
        self.team = alone(heard(flown[-1])[0][0], MAVS)
        self.sight = Filter(AgentConfig(), MAVS, 10.0)

    def hypotheses(self):
        """The truth, and the truth with two names exchanged."""
        return [placement(self.truth[-1]), placement(self.truth[-1][[0, 2, 1, 3]])]

    def replay(self, placements, until=None, best=lambda ticks, tick: -np.inf):
        names = range(10, 10 + len(placements))
        until = until or (lambda: self.newest.tick)
        return replay.replay(self.sight, self.window, placements, self.team, self.newest, until, names, best)

    def replayed(self, *how, **others):
        return finished(self.replay(*how, **others))[0]

    def from_the_start(self, placements, first=0, last=None):
        frames = self.window.frames[first : self.newest.tick + 1 if last is None else last + 1]
        made = Hypotheses.fresh(begin(placements, self.team, self.newest, frames[0]), range(len(placements)))
        made.note(self.sight.update(made.bank, frames[0], replay.FIRST_ITERATIONS), burn_in=True)
        for before, frame in pairwise(frames):
            made.note(self.sight.step(made.bank, before, frame))
        return made


@pytest.mark.parametrize("drop", [lambda k, i: False, lambda k, i: (k + i) % 3 == 0], ids=["all sets", "some sets"])
@pytest.mark.parametrize("seed", range(3))
def test_a_replayed_hypothesis_is_as_one_that_was_there_from_the_start(seed, drop):
    start = Start([1, seed], drop=drop)
    new, old = start.replayed(start.hypotheses()[:1]), start.from_the_start(start.hypotheses()[:1])
    np.testing.assert_array_equal(new.evidence, old.evidence)
    np.testing.assert_array_equal(new.bank.y, old.bank.y)
    np.testing.assert_array_equal(new.bank.P, old.bank.P)
    np.testing.assert_array_equal(new.explained, old.explained)
    assert new.ticks == replay.TICKS - 1


def test_it_goes_no_further_back_than_it_must():
    start = Start(2, ticks=25)
    new = start.replayed(start.hypotheses()[:1])
    old = start.from_the_start(start.hypotheses()[:1], first=25 - replay.TICKS)
    assert new.ticks == replay.TICKS - 1
    np.testing.assert_array_equal(new.evidence, old.evidence)


def test_while_it_catches_up_time_goes_on():
    """Made at tick 12 of 20; every second step another tick comes in."""
    start = Start(3, ticks=20)
    start.newest = start.window.frames[12]
    start.team = alone(start.newest.odometry[0], MAVS)
    asked = []

    def until():
        asked.append(min(19, 12 + len(asked) // 2))
        return asked[-1]

    made = [placement(start.truth[12])]
    new = start.replayed(made, until)
    assert asked[-1] > 12
    old = start.from_the_start(made, first=13 - replay.TICKS, last=asked[-1])
    np.testing.assert_array_equal(new.evidence, old.evidence)


def test_the_truth_earns_more_than_an_exchange_of_names():
    start = Start(4)
    both = start.replayed(start.hypotheses())
    assert both.names.tolist() == [10] or both.lead(0).nats[1] > 100


def test_together_they_earn_what_they_earn_alone():
    start = Start(5)
    true, shifted = start.hypotheses()[0], placement(start.truth[-1])
    shifted.poses[3, :3] += 0.6
    together, single = start.replayed([true, shifted]), start.replayed([true])
    of = together.names.tolist().index(10)
    np.testing.assert_allclose(together.evidence[of], single.evidence[0], atol=1e-5)


def test_those_that_become_one_are_one():
    start = Start(6)
    near = placement(start.truth[-1])
    near.poses[2, :3] += 0.1
    assert len(start.replayed([placement(start.truth[-1]), near])) == 1


def test_who_is_hopelessly_behind_the_leader_is_given_up():
    start = Start(7)
    assert start.replayed(start.hypotheses(), best=lambda ticks, tick: 1e6) is None
    earned = float(start.replayed(start.hypotheses()[:1]).recent()[0])
    kept = start.replayed(start.hypotheses(), best=lambda ticks, tick: earned * ticks / (replay.TICKS - 1))
    assert kept.names.tolist() == [10]


def test_who_falls_behind_what_is_kept_is_given_up():
    start = Start(8, ticks=30)
    assert start.replayed(start.hypotheses(), until=lambda: 99) is None


def test_who_is_localised_keeps_his_place_whatever_a_placement_says():
    start = Start(9)
    y = np.vstack([start.truth[-1], np.zeros(4)])
    start.team = Team(y, np.diag(np.tile([1e-4, 1e-4, 1e-4, 1e-5], MAVS)), np.array([True, True, False, False]))
    wrong = placement(start.truth[-1])
    wrong.poses[1] = 9.0
    found = start.replayed([wrong])
    np.testing.assert_allclose(found.bank.y[0, 1, :3], start.truth[-1][1, :3], atol=0.1)


def test_the_team_was_where_its_odometry_came_from():
    ticks = list(exact(np.random.default_rng(10), 3, 8))
    window = window_of(ticks)
    y = np.vstack([true_poses(ticks[-1]), np.ones(4)])
    then = replay.team_at(Team(y, np.eye(12), np.ones(3, bool)), window.frames[-1], window.frames[0])
    np.testing.assert_allclose(relative_pose(then.y[:3], true_poses(ticks[0])), 0, atol=1e-9)
    np.testing.assert_array_equal(then.y[3], 1)  # the start does not move


def test_every_step_says_what_it_has_cost():
    start = Start(11)
    costs = list(start.replay(start.hypotheses()))
    assert len(costs) == replay.TICKS
    assert min(costs) > replay.CALL
