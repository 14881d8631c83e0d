"""The loop of one agent and of a small team, over the in-memory bus."""

import numpy as np
import pytest

from agent.agent import Agent
from agent.config import AgentConfig
from agent.interface import clock, topics
from agent.interface import messages as m
from agent.interface.bus import MemoryBus
from agent.interface.fleet import Fleet
from agent.interface.frames import compose, relative_pose
from tests import team

EPOCH = 7


SCATTERED = np.array([[0.0, 0, 1.5], [3, 1, 1.2], [-1, 4, 2], [2, -3, 0.9]])  # looks different from every place
IMPATIENT = AgentConfig(wait_for_peers_s=1e-9)


class Rig:
    """Agents that are fed the sensors of a circling team, or of one that hovers at `places`."""

    def __init__(self, seed=0, mavs=3, realtime=False, ticks=20, config=None, places=None):
        self.bus, self.fleet = MemoryBus(), Fleet(mavs=mavs, realtime=realtime)
        self.agents = [Agent(config or AgentConfig(), self.fleet, i, EPOCH, self.bus.another()) for i in self.fleet.ids]
        self.out = self.bus.another().subscribe("**")
        rng = np.random.default_rng(seed)
        flown = team.circling(rng, mavs, ticks) if places is None else team.fly(rng, mavs, ticks, lambda _: places)
        self.ticks = list(flown)
        self.k = 0

    def survey(self):
        for i in self.fleet.ids:
            frames = team.frames_in(self.ticks[0].truth, i)
            self.send(topics.SURVEY, i, m.Survey, frames.tobytes(), 0.2, 0.1)

    def sensors(self, of=None):
        tick = self.ticks[self.k]
        for i in of or self.fleet.ids:
            z = tick.odometry[i]
            quaternion = np.array([0, 0, np.sin(z[3] / 2), np.cos(z[3] / 2)])
            self.send(topics.VIO, i, m.Vio, z[:3].tobytes(), quaternion.tobytes())
            self.send(topics.SIGHTINGS, i, m.Sightings, m.spherical_block(tick.sets[i]))

    def shared(self, of, sets_of_tick, since=0):
        """What these MAVs, counting since that tick, would tell: odometry of this tick, detection sets of that one."""
        for i in of:
            z = self.ticks[self.k].odometry[i]
            self.send(topics.ODOMETRY, i, m.Odometry, z.tobytes(), sender=i, since=since)
            if sets_of_tick >= 0:
                block = m.spherical_block(self.ticks[sets_of_tick].sets[i])
                self.send(topics.DETECTIONS, i, m.Detections, block, sender=i, tick=sets_of_tick)

    def shared_late(self, of, tick):
        """What these MAVs told their peers of an earlier tick."""
        for i in of:
            block = m.spherical_block(self.ticks[tick].sets[i])
            self.send(topics.ODOMETRY, i, m.Odometry, self.ticks[tick].odometry[i].tobytes(), sender=i, tick=tick)
            self.send(topics.DETECTIONS, i, m.Detections, block, sender=i, tick=tick)

    def send(self, topic, mav, kind, *fields, sender=0, tick=None, since=0):
        tick = self.k if tick is None else tick
        message = kind(m.VERSION, EPOCH, sender, tick - since, self.fleet.stamp_ns(tick), *fields)
        self.bus.publish(topics.key(topic, mav), m.encode(message))

    def settle(self, agents=None):
        for _ in range(2):
            for agent in agents or self.agents:
                agent.advance()

    def fly(self, survey=True):
        if survey:
            self.survey()
        for k in range(len(self.ticks)):
            self.k = k
            self.sensors()
            self.settle()
        for i in self.fleet.ids:
            self.send(topics.END, i, m.End)
        self.settle()

    def published(self, *kinds):
        found = []
        for key, payload in self.out.drain():
            try:
                topic, mav = topics.parse(key)
                if topic.kind in kinds:
                    found.append((mav, m.decode(topic.kind, payload, EPOCH)))
            except m.Rejected:  # what a test threw in
                continue
        return found


def test_a_team_localises_itself_and_ends():
    rig = Rig()
    rig.fly()
    assert all(agent.done for agent in rig.agents)
    estimates = rig.published(m.Estimate)
    assert len(estimates) == 3 * 20
    assert all(set(e.states) == {m.LOCALISED} for _, e in estimates[-3:])


def of(mav, published):
    return [message for sender, message in published if sender == mav]


def error_m(rig, station, estimate):
    """Of the last tick's positions of all MAVs, in the station's body frame."""
    believed = m.floats(estimate.poses).reshape(-1, 4)
    believed = relative_pose(np.tile(believed[station - 1], (len(believed), 1)), believed)
    difference = believed - team.frames_in(rig.ticks[rig.k].truth, station)
    return np.linalg.norm(difference[:, :3], axis=1)


def test_a_team_that_is_told_nothing_localises_itself_and_says_how_it_stands():
    rig = Rig(mavs=4, places=SCATTERED)
    rig.fly(survey=False)
    packets = rig.published(m.Estimate, m.Registration)
    for mav in rig.fleet.ids:
        mine = of(mav, packets)
        estimates = [each for each in mine if isinstance(each, m.Estimate)]
        said = [each for each in mine if isinstance(each, m.Registration)]
        assert len(estimates) == 20
        assert set(estimates[-1].states) == {m.LOCALISED}
        assert error_m(rig, mav, estimates[-1]).max() < 0.3
        # At every tick until everybody is localised, and then once more.
        assert [each.stamp_ns for each in said] == [rig.fleet.stamp_ns(k) for k in range(len(said))]
        assert [each.seq for each in said] == list(range(len(said)))
        *before, last = said
        assert before
        assert (last.reasons, last.weights, last.placed, last.poses) == (("",) * 4, b"", b"", b"")
        for registration, estimate in zip(said, estimates, strict=False):
            assert registration.reasons[mav - 1] == ""
            assert [not words for words in registration.reasons] == [s == m.LOCALISED for s in estimate.states]
        assert all(any(each.reasons) for each in before)


def test_a_team_that_looks_the_same_from_every_place_says_which_hypotheses_compete():
    rig = Rig(mavs=4)
    rig.fly(survey=False)
    packets = rig.published(m.Estimate, m.Registration)
    for mav in rig.fleet.ids:
        registration, estimate = (each for each in of(mav, packets) if each.stamp_ns == rig.fleet.stamp_ns(19))
        assert [state == m.LOCALISED for state in estimate.states] == [other == mav for other in rig.fleet.ids]
        assert m.AMBIGUOUS in estimate.states
        weights = m.floats(registration.weights)
        assert len(weights) > 1
        assert weights.sum() == pytest.approx(1)
        placed = np.frombuffer(registration.placed, np.uint8).reshape(-1, 4)
        assert placed[:, mav - 1].all()
        assert placed[0].all()


def test_a_team_that_is_told_says_once_that_all_is_well():
    rig = Rig(ticks=5)
    rig.fly()
    said = sorted((mav, each.seq, each.reasons, each.weights) for mav, each in rig.published(m.Registration))
    assert said == [(mav, 0, ("",) * 3, b"") for mav in rig.fleet.ids]


def hear(late, peers=(2, 3, 4), ticks=20):
    """What the first of four agents believes of peers whose detection sets are late by so many ticks; None: lost."""
    rig = Rig(mavs=4, places=SCATTERED, realtime=True, config=IMPATIENT, ticks=ticks)
    for k in range(ticks):
        rig.k = k
        rig.shared(of=peers, sets_of_tick=-1 if late is None else k - late)
        rig.sensors(of=[1])
        rig.settle(rig.agents[:1])
    packets = rig.published(m.Estimate, m.Status)
    return rig, packets[-2][1], packets[-1][1]


def test_detection_sets_that_are_late_localise_the_team_all_the_same():
    rig, estimate, status = hear(late=1)
    assert status.late == 0  # within the lag
    assert set(estimate.states) == {m.LOCALISED}
    assert error_m(rig, 1, estimate).max() < 0.3
    _, estimate, status = hear(late=None)
    assert status.late == 0
    assert list(estimate.states) == [m.LOCALISED, *[m.SEARCHING] * 3]


def test_a_mav_that_is_never_heard_does_not_keep_the_others_from_being_localised():
    _, estimate, _ = hear(late=0, peers=(2, 3), ticks=40)
    assert list(estimate.states) == [*[m.LOCALISED] * 3, m.SEARCHING]


def station_of(rig):
    """The estimates of the first agent, and its last status."""
    packets = [message for mav, message in rig.published(m.Estimate, m.Status) if mav == 1]
    return [each for each in packets if isinstance(each, m.Estimate)], packets[-1]


@pytest.mark.parametrize(("late", "of_use"), [(1, True), (3, True), (9, True), (10, True), (11, False)])
def test_what_is_late_is_used_within_the_lag_and_counted_beyond(late, of_use):
    """Everything of the peers, odometry and sets."""
    rig = Rig(mavs=4, places=SCATTERED, realtime=True, config=IMPATIENT, ticks=30)
    for k in range(30):
        rig.k = k
        if k >= late:
            rig.shared_late(of=(2, 3, 4), tick=k - late)
        rig.sensors(of=[1])
        rig.settle(rig.agents[:1])
    estimates, status = station_of(rig)
    assert status.late == (0 if of_use else 6 * (30 - late))
    assert (set(estimates[-1].states) == {m.LOCALISED}) == of_use


def test_repetitions_change_no_bit_and_are_counted():
    estimates = []
    for times in (1, 3):
        rig = Rig(mavs=4, places=SCATTERED, realtime=True, config=IMPATIENT)
        for k in range(20):
            rig.k = k
            for _ in range(times):
                if k >= 2:
                    rig.shared_late(of=(2, 3, 4), tick=k - 2)
                rig.sensors(of=[1])
                rig.settle(rig.agents[:1])
        found, status = station_of(rig)
        estimates.append([(each.stamp_ns, each.poses, each.covariances) for each in found])
        assert status.duplicate == (times - 1) * 6 * 17  # those after the last tick are in no status
    assert estimates[0] == estimates[1]


def test_a_peer_that_counts_anew_is_searched_again_and_found():
    """Its process was started again after 2 s, and its odometry began where it stands: no jump that would show."""
    rig = Rig(mavs=4, places=SCATTERED, realtime=True, config=IMPATIENT, ticks=70)
    began, states = rig.ticks[40].odometry[3], []
    for k in range(70):
        rig.k = k
        rig.shared(of=[2, 4], sets_of_tick=k)
        if k < 20:
            rig.shared(of=[3], sets_of_tick=k)
        elif k >= 40:
            rig.ticks[k].odometry[3] = compose(np.array([0, 0, 0, 0.2]), relative_pose(began, rig.ticks[k].odometry[3]))
            rig.shared(of=[3], sets_of_tick=k, since=40)
        rig.sensors(of=[1])
        rig.settle(rig.agents[:1])
        states.append(list(station_of(rig)[0][-1].states))
    localised = [m.LOCALISED] * 4
    assert states[19] == localised
    assert states[40] == [m.LOCALISED, m.LOCALISED, m.SEARCHING, m.LOCALISED]
    assert states[-1] == localised


def test_a_flood_of_any_stamps_changes_no_bit():
    rng, estimates = np.random.default_rng(0), []
    for flooded in (False, True):
        rig = Rig(mavs=4, places=SCATTERED, ticks=12)
        for k in range(12):
            rig.k = k
            rig.sensors()
            rig.settle()
            stamps = [*rng.integers(-(2**61), 2**61, 100), *(k * 10**8 + rng.integers(26 * 10**6, 74 * 10**6, 100))]
            for stamp in stamps if flooded else ():
                payload = m.Odometry(m.VERSION, EPOCH, 2, k, int(stamp), np.ones(4).tobytes())
                rig.bus.publish("air/2/odometry", m.encode(payload))
        packets = rig.published(m.Estimate, m.Status)
        estimates.append([(mav, m.encode(each)) for mav, each in packets if isinstance(each, m.Estimate)])
        last = of(1, packets)[-1]
        assert last.rejected + last.late == (200 * 11 if flooded else 0)
    assert estimates[0] == estimates[1]


@pytest.mark.parametrize("tick", [-10, 0, 3])
def test_detection_sets_that_are_far_too_late_do_no_harm(tick):
    """From before the first tick, and of ones that nobody waits for any more."""
    estimates = []
    for disturbed in (False, True):
        rig = Rig(mavs=4, places=SCATTERED, ticks=12)
        wrong = m.spherical_block(np.array([[3.0, 0.5, 0.1]] * 4))
        for k in range(12):
            rig.k = k
            rig.sensors()
            rig.settle()
            if disturbed and k > 3:
                rig.send(topics.DETECTIONS, 2, m.Detections, wrong, sender=2, tick=tick)
        estimates.append([(mav, m.encode(each)) for mav, each in rig.published(m.Estimate)])
    assert estimates[0] == estimates[1]


def test_the_same_seed_gives_the_same_bits():
    estimates = []
    for _ in range(2):
        rig = Rig(seed=5)
        rig.fly()
        estimates.append([(mav, m.encode(e)) for mav, e in rig.published(m.Estimate)])
    assert estimates[0] == estimates[1]


def test_the_last_status_accounts_for_every_message():
    rig = Rig(ticks=5)
    rig.fly()
    packets = rig.out.drain()
    for mav in rig.fleet.ids:
        mine = [p for p in packets if topics.parse(p.key)[1] == mav and not p.key.startswith("sensor/")]
        final = m.decode(m.Status, mine[-1].payload, EPOCH)
        assert final.final
        assert final.sent == len(mine)
        assert final.sent_bytes == sum(len(p.payload) for p in mine[:-1])


@pytest.mark.parametrize(("waited_s", "hurried"), [(0.001, False), (0.05, True)])
def test_in_real_time_a_tick_that_begins_late_is_hurried(monkeypatch, waited_s, hurried):
    now_s, asked = [100.0], []
    monkeypatch.setattr(clock, "now_s", lambda: now_s[0])
    rig = Rig(realtime=True, mavs=2, config=IMPATIENT)
    (agent, _), tick = rig.agents, rig.agents[0]._localiser.tick
    monkeypatch.setattr(agent._localiser, "tick", lambda *those: asked.append(those[3]) or tick(*those))
    rig.sensors()
    agent.advance()  # it waits for its peer
    assert asked == []
    now_s[0] += waited_s
    agent.advance()
    assert asked == [hurried]


def test_in_lockstep_it_waits_for_its_peers_and_in_real_time_it_does_not():
    rig = Rig()
    rig.survey()
    rig.sensors(of=[1])
    rig.settle()
    assert not rig.published(m.Estimate)
    rig = Rig(realtime=True, config=IMPATIENT)
    rig.survey()
    rig.sensors(of=[1])
    rig.settle()
    assert [mav for mav, _ in rig.published(m.Estimate)] == [1]


@pytest.mark.parametrize(("waiting", "estimated"), [(4, [1, 2, 3, 4]), (15, [15]), (300, [300])])
def test_one_that_was_stopped_goes_on_from_the_newest_readings(waiting, estimated):
    """In real time; a tick or two late it does them all. However long it was: its own sensors are believed."""
    rig = Rig(realtime=True, ticks=waiting + 1, config=IMPATIENT)
    rig.sensors(of=[1])
    rig.settle()
    rig.out.drain()
    for rig.k in range(1, waiting + 1):
        rig.sensors(of=[1])
    for _ in range(waiting):
        rig.settle()
    assert [e.stamp_ns // 10**8 for _, e in rig.published(m.Estimate)] == estimated


def test_in_lockstep_a_tick_closes_without_its_peers_once_nothing_more_will_come():
    rig = Rig()
    rig.survey()
    rig.sensors(of=[1])
    rig.agents[0].advance()
    assert not rig.published(m.Estimate)
    rig.agents[0].advance(all_here=True)
    assert [mav for mav, _ in rig.published(m.Estimate)] == [1]


def test_an_agent_that_waits_goes_on_when_the_bus_says_that_nothing_more_will_come():
    """In memory nothing ever comes while one waits."""
    rig = Rig(ticks=2)
    for k in range(2):
        rig.k = k
        rig.sensors(of=[1])
    rig.send(topics.END, 1, m.End)
    rig.agents[0].run()
    assert rig.agents[0].done
    assert len(rig.published(m.Estimate)) == 2


def test_every_tick_is_answered_with_a_command():
    rig = Rig(ticks=4)
    rig.fly()
    commands = rig.published(m.Setpoint)
    assert sorted((mav, c.stamp_ns) for mav, c in commands) == sorted(
        (i, rig.fleet.stamp_ns(k)) for i in rig.fleet.ids for k in range(4)
    )


@pytest.mark.parametrize("key", ["air/2/odometry", "air/2/detections", "sensor/1/vio", "sensor/1/survey", "air/x/y"])
@pytest.mark.parametrize("payload", [b"", b"\x00", b"\x95\x01\x07\x02\x00\x00", b"\xc1" * 5000, bytes(100_000)])
def test_rubbish_on_any_topic_changes_no_bit_of_the_estimates(key, payload):
    clean, dirty = Rig(ticks=4), Rig(ticks=4)
    clean.fly()
    dirty.bus.publish(key, payload)
    dirty.fly()
    assert [m.encode(e) for _, e in clean.published(m.Estimate)] == [
        m.encode(e) for _, e in dirty.published(m.Estimate)
    ]
