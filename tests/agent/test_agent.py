"""The loop of one agent and of a small team, over the in-memory bus."""

import numpy as np
import pytest

from agent.agent import Agent
from agent.config import AgentConfig
from agent.interface import messages as m
from agent.interface import topics
from agent.interface.bus import MemoryBus
from agent.interface.fleet import Fleet
from tests import team

EPOCH = 7


class Rig:
    """Three agents that are fed the sensors of a circling team."""

    def __init__(self, seed=0, mavs=3, realtime=False, ticks=20, config=None):
        self.bus, self.fleet = MemoryBus(), Fleet(mavs=mavs, realtime=realtime)
        self.agents = [Agent(config or AgentConfig(), self.fleet, i, EPOCH, self.bus.another()) for i in self.fleet.ids]
        self.out = self.bus.another().subscribe("**")
        self.ticks = list(team.circling(np.random.default_rng(seed), mavs, ticks))
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

    def send(self, topic, mav, kind, *fields):
        message = kind(m.VERSION, EPOCH, 0, self.k, self.fleet.stamp_ns(self.k), *fields)
        self.bus.publish(topics.key(topic, mav), m.encode(message))

    def settle(self, agents=None):
        for _ in range(2):
            for agent in agents or self.agents:
                agent.advance()

    def fly(self):
        self.survey()
        for k in range(len(self.ticks)):
            self.k = k
            self.sensors()
            self.settle()
        for i in self.fleet.ids:
            self.send(topics.END, i, m.End)
        self.settle()

    def published(self, kind):
        found = []
        for key, payload in self.out.drain():
            try:
                topic, mav = topics.parse(key)
                if topic.kind is kind:
                    found.append((mav, m.decode(kind, payload, EPOCH)))
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


def test_in_lockstep_it_waits_for_its_peers_and_in_real_time_it_does_not():
    rig = Rig()
    rig.survey()
    rig.sensors(of=[1])
    rig.settle()
    assert not rig.published(m.Estimate)
    rig = Rig(realtime=True, config=AgentConfig(wait_for_peers_s=1e-9))
    rig.survey()
    rig.sensors(of=[1])
    rig.settle()
    assert [mav for mav, _ in rig.published(m.Estimate)] == [1]


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
