"""Who is here, who was first, and who has to give way? Over real sessions; times that pass are set, not waited for."""

import tempfile
from pathlib import Path

import pytest

from agent.interface import presence
from agent.interface.bus import BusError
from agent.interface.presence import HERE, LINKED, RANDOM, AlreadyHere, Presence, meet, occupant
from agent.interface.zenoh_bus import Network, ZenohBus

pytestmark = pytest.mark.system
FIRST, SECOND = RANDOM.start, RANDOM.start + 1


class Mesh:
    """Every process is linked to the witness, and to nobody else."""

    def __init__(self, folder):
        self.folder, self.buses = folder, []
        self.witness = self.join("mav_1", FIRST, socket="witness")
        for stage in (HERE, LINKED):
            self.witness.announce(stage)

    def join(self, name, incarnation, socket):
        connect = () if socket == "witness" else (self.endpoint("witness"),)
        bus = ZenohBus(Network(name, "swarm/test", (self.endpoint(socket),), connect))
        self.buses.append(bus)
        return Presence(bus, 7, incarnation, witness=True)

    def endpoint(self, socket):
        return f"unixsock-stream/{self.folder}/{socket}"

    def until(self, holds):
        while not holds():
            self.witness.look()


@pytest.fixture
def mesh(monkeypatch):
    monkeypatch.setattr(presence, "GRACE_S", 0.0)
    with tempfile.TemporaryDirectory() as folder:  # a short path: socket paths hold 108 characters
        mesh = Mesh(Path(folder))
        yield mesh
        for bus in mesh.buses:
            bus.close()


def test_the_second_with_one_name_finds_out_from_a_third_and_gives_way(mesh):
    first = mesh.join("mav_3", SECOND, "a")  # the higher number, but it is flying already
    first.announce(LINKED)
    mesh.until(lambda: mesh.witness.has_mav(3))
    second = mesh.join("mav_3", FIRST, "b")
    with pytest.raises(AlreadyHere, match=rf"^MAV 3 is already flying \(incarnation {SECOND}, seen by mav_1\)$"):
        meet(second, ("mav_1",), 20)
    mesh.witness.look()
    first.look()  # and is not disturbed


def look_on(*ours):
    while True:
        for each in ours:
            each.look()


def test_of_two_that_start_at_once_the_lower_number_flies(mesh):
    lower, higher = mesh.join("mav_3", FIRST, "a"), mesh.join("mav_3", SECOND, "b")
    for each in (lower, higher):
        each.announce(HERE)
    with pytest.raises(AlreadyHere, match=str(FIRST)):
        look_on(mesh.witness, higher, lower)
    assert not lower.contested


def test_who_was_restarted_replaces_those_before_it_however_long_they_are_seen(mesh):
    before = mesh.join("mav_3", 0, "a")
    before.announce(LINKED)
    mesh.until(lambda: mesh.witness.has_mav(3))
    after = mesh.join("mav_3", 1, "b")
    meet(after, ("mav_1",), 20)
    with pytest.raises(AlreadyHere, match="incarnation 1,"):
        look_on(mesh.witness, before)


def test_a_token_goes_with_its_process_and_with_those_who_saw_it(mesh):
    other = mesh.join("mav_3", FIRST, "a")
    other.announce(LINKED)
    mesh.until(lambda: mesh.witness.has_mav(3))
    mesh.buses[-1].close()
    mesh.until(lambda: not mesh.witness.has_mav(3))
    again = mesh.join("mav_3", SECOND, "a")
    again.ask()
    assert not again.contested


def test_who_does_not_come_is_named(mesh):
    with pytest.raises(BusError, match=r"^mav_1: waited 0 s in vain for mav_2, world$"):
        meet(mesh.witness, ("mav_2", "world"), 0)


def test_who_has_the_address_is_asked_for_its_name(mesh):
    network = mesh.buses[0].network
    assert occupant(network) == "MAV 1 is already flying"


def test_nonsense_among_the_tokens_is_ignored(mesh):
    bus = mesh.buses[0]
    for key in ("alive/x", "alive/mav_3/7/x/linked", "alive/mav_3/8/0/linked", "alive/mav_3/7/0/landed", "seen/a/b"):
        bus.announce(key)
    mesh.witness.ask()
    assert not mesh.witness.has_mav(3)
