"""The two buses keep the same promises."""

import tempfile
from pathlib import Path

import pytest
import zenoh

from agent.interface.bus import BusError, MemoryBus, Packet
from agent.interface.zenoh_bus import Network, ZenohBus


@pytest.fixture
def sockets():
    with tempfile.TemporaryDirectory() as folder:  # a short path: socket paths hold 108 characters
        yield Path(folder)


def network(sockets, name, connect=(), **more):
    def endpoint(of):
        return f"unixsock-stream/{sockets}/{of}.sock"

    return Network(name, "swarm/test", (endpoint(name),), tuple(map(endpoint, connect)), **more)


def meet(*buses):
    for bus in buses:
        bus.announce(f"alive/{bus.network.name}")
    for bus in buses:
        bus.await_alive([f"alive/{other.network.name}" for other in buses if other is not bus], 10)


def test_memory_delivers_in_order_to_every_match_and_not_to_itself():
    speaker = MemoryBus()
    listener = speaker.another()
    every, one, some = (listener.subscribe(p) for p in ("**", "air/1/odometry", "air/*/odometry"))
    own = speaker.subscribe("**")
    for key in ("air/1/odometry", "air/2/odometry", "air/2/detections", "air"):
        speaker.publish(key, key.encode())
    assert [p.key for p in every.drain()] == ["air/1/odometry", "air/2/odometry", "air/2/detections", "air"]
    assert one.drain() == [Packet("air/1/odometry", b"air/1/odometry")]
    assert [p.key for p in some.drain()] == ["air/1/odometry", "air/2/odometry"]
    assert one.wait(None) == []
    assert own.drain() == []


def test_memory_reaches_those_who_subscribe_later():
    speaker = MemoryBus()
    speaker.publish("a/1", b"")
    later = speaker.another().subscribe("a/*")
    speaker.publish("a/1", b"x")
    assert later.drain() == [Packet("a/1", b"x")]


def test_memory_forgets_who_has_left():
    speaker = MemoryBus()
    gone, stays = speaker.another(), speaker.another()
    inbox, other = gone.subscribe("a/*"), stays.subscribe("a/*")
    speaker.publish("a/1", b"x")
    gone.close()
    later = speaker.another().subscribe("a/*")  # as many as before
    speaker.publish("a/1", b"y")
    assert [p.payload for p in inbox.drain()] == [b"x"]
    assert [p.payload for p in other.drain()] == [b"x", b"y"]
    assert [p.payload for p in later.drain()] == [b"y"]


@pytest.mark.system
def test_zenoh_delivers_everything_in_order_and_not_to_itself(sockets):
    with ZenohBus(network(sockets, "a")) as a, ZenohBus(network(sockets, "b", ["a"])) as b:
        inbox, own = b.subscribe("air/*/odometry"), a.subscribe("air/**")
        meet(a, b)
        sent = [Packet(f"air/{k % 3}/odometry", bytes([k])) for k in range(200)]
        for packet in sent:
            a.publish(*packet)
        got = []
        while len(got) < len(sent):
            got += inbox.wait(None)
        assert got == sent
        assert own.drain() == []
        assert inbox.wait(0.0) == []


@pytest.mark.system
def test_truth_does_not_reach_those_who_are_denied_it(sockets):
    with (
        ZenohBus(network(sockets, "world")) as world,
        ZenohBus(network(sockets, "mav_1", ["world"], deny=("truth/**",))) as agent,
    ):
        truth, sensor = agent.subscribe("truth/**"), agent.subscribe("sensor/**")
        meet(world, agent)
        world.publish("truth/1/pose", b"secret")
        world.publish("sensor/1/vio", b"fair")
        assert sensor.wait(None) == [Packet("sensor/1/vio", b"fair")]
        assert truth.drain() == []


@pytest.mark.system
def test_who_may_not_hear_of_something_may_speak_of_it(sockets):
    with (
        ZenohBus(network(sockets, "recorder")) as recorder,
        ZenohBus(network(sockets, "mav_1", ["recorder"], deny=("truth/**", "fault/**"))) as agent,
    ):
        everything, faults = recorder.subscribe("**"), agent.subscribe("fault/**")
        meet(recorder, agent)
        recorder.publish("fault/2/arrivals", b"secret")
        agent.publish("fault/1/arrivals", b"journal")
        agent.publish("air/1/odometry", b"last")
        got = []
        while len(got) < 2:
            got += everything.wait(None)
        assert got == [Packet("fault/1/arrivals", b"journal"), Packet("air/1/odometry", b"last")]
        assert faults.drain() == []


@pytest.mark.system
def test_who_does_not_come_is_named(sockets):
    with ZenohBus(network(sockets, "a")) as a, pytest.raises(BusError, match=r"a: waited 0\.05 s .*alive/b"):
        a.await_alive(["alive/b"], 0.05)


@pytest.mark.system
def test_a_socket_that_cannot_be_had_is_one_clear_error(sockets):
    with pytest.raises(BusError, match=r"a: cannot open the network.*No such file or directory$") as caught:
        ZenohBus(Network("a", "swarm/test", (f"unixsock-stream/{sockets}/no/such/folder/a.sock",)))
    assert ".rs" not in str(caught.value)  # where in Zenoh's source


@pytest.mark.system
def test_who_cannot_leave_says_so_unless_something_else_came_first(sockets, monkeypatch):
    class Stuck:
        def close(self):
            raise zenoh.ZError("close operation timed out! at /somewhere/close.rs:135.")

    with ZenohBus(network(sockets, "a")) as bus, monkeypatch.context() as patch:
        patch.setattr(bus, "_session", Stuck())
        words = r"a: cannot leave the network, somebody does not take what was sent: close operation timed out!$"
        with pytest.raises(BusError, match=words), bus:
            pass
        with pytest.raises(KeyError), bus:
            raise KeyError
