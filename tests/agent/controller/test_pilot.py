"""Do pilots that only hear one another's intents fly the mission, each from its own noisy estimate?"""

import numpy as np
import pytest
from msgspec.structs import replace

from agent.controller.pilot import Pilot
from agent.controller.surroundings import Surroundings
from agent.interface.fleet import Fleet
from agent.interface.frames import compose, inverse
from agent.interface.intent import FORMING, HOLDING, LANDED, LOST, PHASES, READY, Intent
from agent.interface.mission import Leg, Mission, check

TICK_NS = 100_000_000
LINE, LONG = (Leg("line", length_m=4.0, hold_s=hold_s) for hold_s in (3.0, 60.0))


class Team:
    """MAVs that are where they want to be, and know one another's poses to within a few centimetres."""

    def __init__(self, mission, seed=0, mavs=5, noise_m=0.02, delay=1):
        check(mission, Fleet(mavs=mavs))
        rng = np.random.default_rng(seed)
        places = 1.3 * np.stack(np.unravel_index(rng.permutation(9)[:mavs], (3, 3)), axis=1)
        self.frames = np.column_stack([places, np.zeros(mavs), rng.uniform(-3, 3, mavs)])  # world, where odometry began
        self.rng, self.noise_m, self.delay, self.k = rng, noise_m, delay, 0
        self.pilots = {mav: Pilot(mission, mav) for mav in range(1, mavs + 1)}
        self.readings = np.zeros((mavs, 4))
        self.said = []  # by tick: what each was about to do
        self.gone, self.unknown, self.turned = set(), set(), set()  # turned: whose yaw is not known
        self.track = []

    @property
    def poses(self):
        """(N, 4) in the world."""
        return compose(self.frames, self.readings)

    def fly(self, ticks):
        for _ in range(ticks):
            heard = self.said[-self.delay] if len(self.said) >= self.delay else {}
            wanted = {mav: p.fly(self.here(mav, heard)) for mav, p in self.pilots.items() if mav not in self.gone}
            self.said.append({mav: pilot.intent for mav, pilot in self.pilots.items() if mav not in self.gone})
            for mav, each in wanted.items():
                self.readings[mav - 1, :3] = each.position
            self.k += 1
            self.track.append(self.poses[:, :3])

    def here(self, mav, heard):
        mavs, own = len(self.frames), mav - 1
        noise = self.rng.normal(0, self.noise_m, (mavs, 4)) * [1, 1, 1, 0.1]
        noise[own] = 0
        into = np.repeat(inverse(self.frames[own])[None], mavs, axis=0)
        return Surroundings(
            self.k * TICK_NS,
            self.readings[own].copy(),
            compose(into, self.poses) + noise,
            np.full(mavs, self.noise_m),
            compose(into, self.frames) + noise,
            np.array([other + 1 not in self.unknown | self.turned | self.gone for other in range(mavs)]),
            np.array([other + 1 not in self.unknown for other in range(mavs)]),
            np.array([other + 1 not in self.gone for other in range(mavs)]),
            {other: intent for other, intent in heard.items() if other != mav and other not in self.gone},
        )

    def phases(self):
        return {mav: PHASES[pilot.intent.phase] for mav, pilot in self.pilots.items() if mav not in self.gone}

    def nearest_m(self):
        track = np.array(self.track)
        apart = np.linalg.norm(track[:, :, None] - track[:, None], axis=-1) + 9 * np.eye(track.shape[1])
        return apart.min()


def off_line(team, length_m=4.0):
    """Largest distance from a line of this length, wherever it is and however it is turned."""
    p = team.poses[:, :3] - team.poses[:, :3].mean(0)
    way = np.linalg.svd(p)[2][0]
    along = np.sort(p @ way)
    return max(
        np.abs(along - np.linspace(-0.5, 0.5, len(p)) * length_m).max(), np.abs(p - np.outer(p @ way, way)).max()
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("delay", [1, 5])
def test_they_take_off_form_a_line_and_land(seed, delay):
    team = Team(Mission((LINE,)), seed, delay=delay)
    while {pilot.intent.phase for pilot in team.pilots.values()} != {HOLDING}:
        team.fly(1)
        assert team.k < 300, team.phases()
    assert off_line(team) < 0.1
    assert sorted(pilot.intent.place for pilot in team.pilots.values()) == [0, 1, 2, 3, 4]
    assert team.nearest_m() > 0.65
    team.fly(150)
    assert {pilot.intent.phase for pilot in team.pilots.values()} == {LANDED}
    np.testing.assert_allclose(team.poses[:, 2], 0, atol=1e-6)


def test_all_set_out_in_the_same_tick_and_take_the_same_time():
    team = Team(Mission((LINE,)), 1, delay=3)
    began, ended = {}, {}
    while len(ended) < 5:
        team.fly(1)
        for mav, pilot in team.pilots.items():
            if pilot.intent.phase == FORMING:
                began.setdefault(mav, team.k)
            if pilot.intent.phase == HOLDING:
                ended.setdefault(mav, team.k)
        assert team.k < 300
    assert len(set(began.values())) == 1
    assert max(ended.values()) - min(ended.values()) <= 1


def test_formation_follows_formation():
    mission = Mission((LINE, Leg("circle", radius_m=1.35, hold_s=2.0), Leg("v", length_m=3.0, hold_s=2.0)))
    team = Team(mission, 2)
    reached = []
    while team.pilots[1].intent.phase != LANDED:
        team.fly(1)
        phases = {(pilot.intent.phase, pilot.intent.formation) for pilot in team.pilots.values()}
        if len(phases) == 1 and phases not in reached and phases & {(HOLDING, k) for k in range(3)}:
            reached.append(phases)
        assert team.k < 1000, team.phases()
    assert reached == [{(HOLDING, 0)}, {(HOLDING, 1)}, {(HOLDING, 2)}]
    assert team.nearest_m() > 0.65


def test_who_is_not_localised_keeps_all_waiting():
    team = Team(Mission((LONG,), land_after_s=60.0))
    team.unknown = {4}
    team.fly(150)
    assert {pilot.intent.phase for pilot in team.pilots.values()} == {READY}
    team.unknown = set()
    team.fly(120)
    assert {pilot.intent.phase for pilot in team.pilots.values()} == {HOLDING}


def test_who_is_never_localised_is_not_waited_for_without_end():
    team = Team(Mission((LONG,), land_after_s=8.0))
    team.unknown = {4}
    team.fly(250)
    assert {pilot.intent.phase for pilot in team.pilots.values()} == {LANDED}


def test_nobody_is_sent_where_one_hangs_that_is_gone():
    team = Team(Mission((LINE, replace(LINE, length_m=8.0), replace(LONG, hold_s=60.0))), 3)
    while team.pilots[2].intent.phase != HOLDING:
        team.fly(1)
    team.gone = {2}
    team.fly(300)
    flying = (1, 3, 4, 5)
    assert {(team.pilots[mav].intent.phase, team.pilots[mav].intent.formation) for mav in flying} == {(HOLDING, 2)}
    assert team.nearest_m() > 0.65


def test_a_teammate_that_is_gone_is_not_waited_for():
    team = Team(Mission((LONG,)), 3)
    team.fly(30)
    team.gone = {2}
    team.fly(120)
    assert {team.pilots[mav].intent.phase for mav in (1, 3, 4, 5)} == {HOLDING}
    assert len({team.pilots[mav].intent.place for mav in (1, 3, 4, 5)}) == 4


def test_without_the_leader_they_stop_and_land():
    team = Team(Mission((LINE,), land_after_s=8.0), 4)
    while team.pilots[2].intent.phase != FORMING:
        team.fly(1)
    team.fly(15)
    team.gone = {1}
    team.fly(60)
    assert {team.pilots[mav].intent.phase for mav in (2, 3, 4, 5)} == {LOST}
    still = team.poses.copy()
    team.fly(5)
    np.testing.assert_allclose(team.poses[1:], still[1:], atol=0.05)
    team.fly(150)
    assert {team.pilots[mav].intent.phase for mav in (2, 3, 4, 5)} == {LANDED}
    assert team.nearest_m() > 0.65


def test_the_leader_is_back_and_they_go_on():
    team = Team(Mission((LONG,)), 4)
    while team.pilots[2].intent.phase != FORMING:
        team.fly(1)
    team.fly(15)
    team.unknown = {3}
    team.fly(20)
    assert {team.pilots[mav].intent.phase for mav in range(1, 6)} == {LOST}
    team.unknown = set()
    team.fly(120)
    assert {team.pilots[mav].intent.phase for mav in range(1, 6)} == {HOLDING}
    assert off_line(team) < 0.1


def test_they_go_on_though_one_is_silent_and_may_have_turned():
    team = Team(Mission((LONG,)), 4)
    while team.pilots[2].intent.phase != FORMING:
        team.fly(1)
    team.turned = {1, 3}
    team.fly(120)
    assert {team.pilots[mav].intent.phase for mav in range(1, 6)} == {HOLDING}
    assert off_line(team) < 0.1


def test_nobody_sets_out_while_one_may_have_turned():
    team = Team(Mission((LONG,), land_after_s=60.0), 4)
    team.turned = {3}
    team.fly(150)
    assert {pilot.intent.phase for pilot in team.pilots.values()} == {READY}


def test_one_that_is_started_anew_in_the_air_does_not_take_off_again():
    mission = Mission((LONG,))
    team = Team(mission, 5)
    while team.pilots[3].intent.phase != HOLDING:
        team.fly(1)
    team.fly(5)
    before = team.poses[2].copy()
    team.frames[2], team.readings[2] = before, 0.0
    team.pilots[3] = Pilot(mission, 3)
    team.fly(100)
    assert team.pilots[3].intent.phase == HOLDING
    assert off_line(team) < 0.1
    assert np.array(team.track)[-100:, 2, 2].max() < before[2] + 0.2


@pytest.mark.parametrize("closed", [True, False])
def test_drift_is_followed_if_it_is_closed_loop(closed):
    team = Team(Mission((LONG,), replan_beyond_m=0.05 if closed else np.inf), 6)
    while team.pilots[3].intent.phase != HOLDING:
        team.fly(1)
    for _ in range(50):
        team.frames[2, 0] += 0.01  # the third's odometry drifts by half a metre, and it with it
        team.fly(1)
    team.fly(15)
    assert (off_line(team) < 0.12) == closed


def test_intents_that_make_no_sense_in_this_mission_do_not_count():
    team = Team(Mission((LONG,)), 7)
    nonsense = [Intent(READY, 9, 2, 0, 1.0), Intent(FORMING, 0, 77, 0, 1.0)]
    team.fly(1)
    for k in range(150):
        team.said[-1][5] = nonsense[k % 2]
        team.fly(1)
    assert {team.pilots[mav].intent.phase for mav in (1, 2, 3, 4)} == {HOLDING}
