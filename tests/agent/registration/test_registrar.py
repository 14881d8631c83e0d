"""One station from nothing to a localised team, its filter aside."""

import numpy as np
import pytest

from agent.config import AgentConfig, Registration
from agent.interface.frames import wrap
from agent.interface.messages import AMBIGUOUS
from agent.registration import registrar as module
from agent.registration.bank import Team
from agent.registration.challenge import challenge
from agent.registration.registrar import Registrar
from agent.registration.verdict import LEAST_TICKS
from agent.registration.window import carried
from tests import team as teams
from tests.agent.registration.beginning import alone, box, heard, hovering, true_poses, wandering


class Station:
    """Believes what is committed, and goes on by odometry."""

    def __init__(self, mavs, station=1, work=None, hurried=False):
        self.hurried = hurried
        config = AgentConfig() if work is None else AgentConfig(registration=Registration(work_per_mav=work))
        self.mavs, self.station, self.registrar = mavs, station, Registrar(config, mavs, 10.0)
        self.team, self.since, self.readings = None, 0, {}  # as it was at that tick; by tick and index
        self.commits = []

    def hear(self, k, odometry, sets, late=()):
        for tick, index, what in late:
            self.registrar.late(tick, index, **what)
            if "odometry" in what:
                self.readings[tick][index] = what["odometry"]
        self.registrar.tick(k, odometry, sets)
        self.readings[k] = dict(odometry)
        if self.team is None:
            self.team, self.since = alone(odometry[0], self.mavs), k
        self.registrar.advance(self.team.placed)
        newest = self.registrar.newest
        team = self.team if newest < self.since else self.team_at(newest)
        commit = self.registrar.work_on(team, self.hurried)
        if commit is not None:
            self.commits.append((commit.tick, commit, k))
            placed = self.team.placed | np.isin(np.arange(self.mavs), commit.mavs)
            known = np.repeat([*placed[1:], True], 4)
            y = np.where([[each] for each in (*placed, True)], commit.y, 0)
            self.team, self.since = Team(y, np.where(known[:, None] & known, commit.P, 0), placed), commit.tick
        return commit

    def team_at(self, tick):
        y = self.team.y.copy()
        for j in np.flatnonzero(self.team.placed):
            there, here = self.readings[self.since].get(j), self.readings[tick].get(j)
            if there is not None and here is not None:
                y[j] = carried(y[j], there, here)
        return Team(y, self.team.P, self.team.placed)


def registered(
    ticks, station=1, work=None, lost=lambda k, i: False, unread=lambda k, i: False, delay=0, first=0, hurried=False
):
    """A station that has heard these ticks; the others' sets may be lost or late, their odometry unread."""
    own = Station(len(ticks[0].truth), station, work, hurried)
    for k, tick in enumerate(ticks):
        odometry, sets = heard(tick, station)
        odometry = {i: z for i, z in odometry.items() if i == 0 or not unread(k, i)}
        sets = {i: z for i, z in sets.items() if i == 0 or not lost(k, i)}
        late = []
        if delay:
            sets = {0: sets[0]}
            if k >= delay:
                before = heard(ticks[k - delay], station)[1]
                late = [
                    (first + k - delay, i, {"spherical": z}) for i, z in before.items() if i and not lost(k - delay, i)
                ]
        own.hear(first + k, odometry, sets, late)
        if own.team.placed.all():
            break
    return own


def rightly(own, ticks, first=0):
    """Whether everything that was committed was right; the same tolerance as for a wrong identity."""
    for k, commit, _ in own.commits:
        off = commit.y[commit.mavs] - true_poses(ticks[k - first], own.station)[commit.mavs]
        if np.linalg.norm(off[:, :3], axis=1).max() > 0.5 or np.abs(wrap(off[:, 3])).max() > 0.15:
            return False
    return True


def regular_circle(seed, mavs, ticks):
    angle = 2 * np.pi * np.arange(mavs) / mavs
    places = 1.35 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    return list(teams.fly(np.random.default_rng(seed), mavs, ticks, lambda t: places))


@pytest.mark.parametrize("fly", [hovering, wandering])
@pytest.mark.parametrize("seed", range(10))
def test_a_random_box_is_localised_in_15_ticks(fly, seed):
    ticks = fly([1, seed], 5, 15)
    own = registered(ticks, station=1 + seed % 5)
    assert own.team.placed.all()
    assert rightly(own, ticks)


@pytest.mark.parametrize("station", [1, 2, 3])
def test_in_a_regular_line_nobody_is_ever_localised(station):
    """Not even the MAV on the mirrored place, which is certain: what is seen of the others would be taken for it."""
    places = np.column_stack([np.zeros(5), 1.5 * np.arange(5), np.zeros(5)])
    own = registered(hovering([18, station], 5, 40, places), station=station)
    assert own.commits == []
    assert (own.registrar.situation(list(range(1, 6)), own.team.placed).states[1:] == AMBIGUOUS).all()


@pytest.mark.parametrize(("mavs", "seed"), [(3, 0), (3, 1), (5, 0)])
def test_in_a_regular_circle_nobody_is_ever_localised(mavs, seed):
    own = registered(regular_circle([2, seed], mavs, 40))
    assert own.commits == []


def challenged_in(ticks, monkeypatch):
    """The ticks in which station 1 has begun to test a leader."""
    begun = []
    monkeypatch.setattr(module, "challenge", lambda *of: begun.append(of[3][-1].tick) or challenge(*of))
    assert rightly(registered(ticks), ticks)
    return begun


def test_equals_that_lead_in_turns_are_tested_ever_less_often(monkeypatch):
    begun = challenged_in(regular_circle([3, 0], 7, 60), monkeypatch)
    assert len([k for k in begun if k >= 30]) <= 3


def test_when_equals_differ_at_last_they_are_soon_told_apart():
    """A circle that takes off to different heights after a long time of rest."""
    angle = 2 * np.pi * np.arange(7) / 7
    places = 1.35 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    up = np.outer(np.arange(7), [0, 0, 0.16])  # m/s
    ticks = list(teams.fly(np.random.default_rng(3), 7, 60, lambda t: places + max(t - 4.5, 0) * up))
    own = registered(ticks)
    assert own.team.placed.all()
    assert rightly(own, ticks)
    assert own.commits[0][2] > 45


def test_the_same_inputs_give_the_same_bits():
    one, other = (registered(hovering(3, 5, 15)) for _ in range(2))
    assert [k for k, *_ in one.commits] == [k for k, *_ in other.commits]
    for (_, a, _), (_, b, _) in zip(one.commits, other.commits, strict=True):
        assert a.y.tobytes() == b.y.tobytes()
        assert a.P.tobytes() == b.P.tobytes()


@pytest.mark.parametrize("seed", range(3))
def test_a_third_of_the_work_only_makes_it_later(seed):
    ticks = hovering([4, seed], 5, 60)
    soon, later = registered(ticks), registered(ticks, work=Registration().work_per_mav / 3)
    assert later.team.placed.all()
    assert rightly(later, ticks)
    assert soon.commits[-1][0] < later.commits[-1][0]


def test_one_that_is_always_late_takes_longer_but_not_for_ever():
    ticks = hovering(4, 7, 40)
    soon, later = registered(ticks), registered(ticks, hurried=True)
    assert rightly(later, ticks)
    assert later.commits[-1][2] > soon.commits[-1][2]


def test_a_tenth_of_the_work_only_makes_it_later():
    ticks = hovering([4, 0], 5, 100)
    own = registered(ticks, work=Registration().work_per_mav / 10)
    assert own.team.placed.all()


@pytest.mark.parametrize("seed", range(4))
def test_sets_may_be_two_ticks_late(seed):
    ticks = hovering([5, seed], 5, 20)
    own = registered(ticks, delay=2)
    assert own.team.placed.all()
    assert rightly(own, ticks)
    assert own.commits[-1][2] >= LEAST_TICKS + 1


def test_what_is_committed_is_where_they_are_now_though_the_sets_are_late():
    rng = np.random.default_rng(17)
    places = box(rng, 5)
    ticks = list(teams.fly(rng, 5, 20, lambda t: places + np.array([5.0 * t, 0, 0])))
    own = registered(ticks, delay=2)
    assert own.team.placed.all()
    assert rightly(own, ticks)


@pytest.mark.parametrize(("seed", "delay"), [(0, 0), (1, 0), (2, 0), (3, 0), (4, 2), (5, 2)])
def test_three_sets_in_ten_may_be_lost_and_the_rest_late(seed, delay):
    ticks = hovering([6, seed], 5, 40)
    gone = np.random.default_rng([6, seed]).random((40, 5)) < 0.3
    own = registered(ticks, lost=lambda k, i: gone[k, i], delay=delay)
    assert own.team.placed.all()
    assert rightly(own, ticks)


@pytest.mark.parametrize("seed", range(2))
def test_readings_may_be_lost_too(seed):
    ticks = wandering([8, seed], 5, 40)
    gone = np.random.default_rng([8, seed]).random((40, 5)) < 0.3
    own = registered(ticks, lost=lambda k, i: gone[k, i], unread=lambda k, i: gone[k, i])
    assert own.team.placed.all()
    assert rightly(own, ticks)


@pytest.mark.parametrize("silent", [1, 60])
def test_others_are_localised_though_one_has_not_been_heard_yet(silent):
    """In its first tick, or in none."""
    ticks = hovering(9, 5, 40)
    own = registered(ticks, lost=lambda k, i: i == 3 and k < silent, unread=lambda k, i: i == 3 and k < silent)
    assert own.team.placed[[0, 1, 2, 4]].all()


def test_who_falls_silent_does_not_hold_up_the_others():
    ticks = hovering(10, 5, 40)
    own = registered(ticks, lost=lambda k, i: i == 3 and k > 0, unread=lambda k, i: i == 3 and k > 0)
    assert own.team.placed[[0, 1, 2, 4]].all()
    assert rightly(own, ticks)


def test_after_a_gap_it_begins_anew():
    ticks = hovering(11, 5, 40)
    own = Station(5)
    for k in range(LEAST_TICKS - 1):
        own.hear(k, *heard(ticks[k]))
    own.hear(20, *heard(ticks[20]))
    words = own.registrar.situation([1, 2, 3, 4, 5], own.team.placed).reasons[1]
    assert words == f"1 of {LEAST_TICKS} ticks heard that the search begins with"
    for k in range(21, 40):
        own.hear(k, *heard(ticks[k]))
    assert own.team.placed.all()
    assert own.commits[0][0] > 20
    assert rightly(own, ticks)


def test_ticks_may_be_counted_from_anywhere():
    ticks = hovering(12, 5, 15)
    own, far = registered(ticks), registered(ticks, first=10**6)
    assert [k + 10**6 for k, *_ in own.commits] == [k for k, *_ in far.commits]
    assert own.commits[-1][1].y.tobytes() == far.commits[-1][1].y.tobytes()


def test_sets_of_ticks_that_nobody_knows_any_more_do_no_harm():
    ticks, own = hovering(13, 5, 15), Station(5)
    for k, tick in enumerate(ticks):
        own.hear(k, *heard(tick), late=[(k + off, 2, {"spherical": np.ones((3, 3))}) for off in (-100, 5)])
    assert own.team.placed.all()
    assert rightly(own, ticks)


def joins(ticks, mavs):
    """When the last of a team whose others are localised is so, too."""
    registrar = Registrar(AgentConfig(), mavs, 10.0)
    P = np.diag(np.tile([1e-4, 1e-4, 1e-4, 1e-5], mavs))
    for k, tick in enumerate(ticks):
        registrar.tick(k, *heard(tick))
        truth, placed = true_poses(tick), np.arange(mavs) < mavs - 1
        registrar.advance(placed)
        commit = registrar.work_on(Team(np.vstack([truth, np.zeros(4)]), P, placed))
        if commit is not None:
            off = commit.y[mavs - 1] - truth[mavs - 1]
            assert commit.mavs.tolist() == [mavs - 1]
            assert np.abs([*off[:3], wrap(off[3])]).max() < 0.2
            return k
    return None


@pytest.mark.parametrize("seed", range(3))
def test_one_more_is_found_by_a_team(seed):
    assert joins(hovering([14, seed], 5, 15), 5) is not None


def test_a_circle_that_lacks_one_has_one_place_for_him():
    assert joins(regular_circle(15, 4, 15), 4) is not None


@pytest.mark.parametrize("mavs", [5, 7])
def test_a_larger_circle_too(mavs):
    assert joins(regular_circle(15, mavs, 30), mavs) is not None


def test_with_everybody_localised_there_is_nothing_to_do():
    ticks = hovering(16, 5, 20)
    own = registered(ticks)
    for k in range(own.commits[-1][0] + 1, 20):
        assert own.hear(k, *heard(ticks[k])) is None
    assert own.registrar.situation([1, 2, 3, 4, 5], own.team.placed).reasons == ("",) * 5


@pytest.mark.statistical
@pytest.mark.parametrize("seed", range(4))
def test_a_circle_two_centimetres_from_regular_is_decided_in_seconds_and_rightly(seed):
    """Five ticks do not tell the exchanges of identity apart; those of some seconds do."""
    rng = np.random.default_rng([18, seed])
    angle = 2 * np.pi * np.arange(5) / 5
    places = 1.35 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) + rng.normal(0, 0.02, (5, 3))
    ticks = list(teams.fly(rng, 5, 60, lambda t: places))
    own = registered(ticks)
    assert own.team.placed.all()
    assert rightly(own, ticks)


def test_hypotheses_that_place_one_of_the_team_elsewhere_are_dropped():
    """In a regular circle any exchange may be; once MAV 1 is in the team, he is where he is in all that is left."""
    mavs, ticks = 5, regular_circle(19, 5, 30)
    registrar, P = Registrar(AgentConfig(), mavs, 10.0), np.diag(np.tile([1e-4, 1e-4, 1e-4, 1e-5], mavs))

    def places_of_1(k, placed):
        registrar.tick(k, *heard(ticks[k]))
        truth = true_poses(ticks[k])
        registrar.advance(np.arange(mavs) < placed)
        registrar.work_on(Team(np.vstack([truth, np.zeros(4)]), P, np.arange(mavs) < placed))
        found = registrar.situation(list(range(1, mavs + 1)), np.arange(mavs) < placed)
        return np.linalg.norm(found.poses[found.placed[:, 1], 1, :3] - truth[1, :3], axis=1)

    apart = [places_of_1(k, 1) for k in range(20)][-1]
    assert apart.max() > 0.5
    apart = places_of_1(20, 2)
    assert apart.max(initial=0) < 0.3
