"""Is the [faults] table read as it is written, and refused with exact words if it makes no sense?"""

import math
import tomllib
from typing import Any

import pytest

from agent.interface.fleet import Fleet
from agent.interface.tables import BadExperiment
from deploy.experiment import from_text, load
from deploy.faults import Faults, LinkRule, Partition, ProcessFault, parse

FLEET = Fleet(mavs=5, duration_s=20.0)
EVERYTHING = """
loss = 0.1
burst_loss = 0.5
burst_s = 2.0
delay_ms = 200
jitter_ms = 50.0
jitter = "lognormal"
duplicates = 0.1
reorder = 0.2
bandwidth_bytes_s = 2e4
topics = ["odometry"]

[[links]]
senders = [1, 2]
receivers = [3]
from_s = 2.0
until_s = 5.0
loss = 1.0

[[partitions]]
groups = [[1, 2], [3, 4, 5]]
from_s = 4.0
until_s = 6.0
one_way = true
kept = true

[[processes]]
mav = 2
do = "kill"
at_s = 3.05

[[processes]]
mav = 2
do = "restart"
at_s = 8.0
"""


def read(text: str) -> Faults:
    return parse(tomllib.loads(text), FLEET)


def test_every_key_is_read() -> None:
    faults = read(EVERYTHING)
    assert faults.links == (LinkRule(senders=(1, 2), receivers=(3,), from_s=2.0, until_s=5.0, loss=1.0),)
    cut = Partition(groups=((1, 2), (3, 4, 5)), from_s=4.0, until_s=6.0, one_way=True, kept=True)
    assert faults.partitions == (cut,)
    assert faults.processes[0] == ProcessFault(mav=2, do="kill", at_s=3.05)
    shared, rule = faults.rules()
    assert (shared.loss, shared.jitter, shared.topics, shared.until_s) == (0.1, "lognormal", ("odometry",), math.inf)
    assert rule is faults.links[0]
    assert faults.on_links
    assert faults.present


def test_nothing_said_is_no_fault() -> None:
    assert not parse({}, FLEET).present
    assert not read("loss = 0.0\ntopics = ['odometry']").present
    assert not read("[[links]]\nsenders = [1]").on_links
    only_processes = read("[[processes]]\nmav = 1\ndo = 'kill'\nat_s = 1")
    assert (only_processes.on_links, only_processes.present) == (False, True)


def test_a_resolved_experiment_keeps_its_faults(tmp_path: Any) -> None:
    path = tmp_path / "mine.toml"
    table = EVERYTHING.replace("\n[[", "\n[[faults.")
    path.write_text(f'[[world.path]]\nformation = "circle"\nradius_m = 2.0\n[faults]\n{table}')
    first = load(str(path), ["faults.links.0.loss=0.5"])
    assert first.faults.links[0].loss == 0.5
    assert from_text(first.toml()).faults == first.faults


def test_a_process_fault_is_before_the_first_tick_at_or_after_its_time() -> None:
    kill, restart = read(EVERYTHING).processes
    assert (kill.tick(FLEET), restart.tick(FLEET)) == (31, 80)
    faults = read(EVERYTHING)
    assert [faults.due(tick, FLEET) for tick in (30, 31, 80)] == [[], [kill], [restart]]
    third = ProcessFault(mav=1, do="kill", at_s=0.3)  # 0.3 x 10 is a little more than 3
    assert third.tick(FLEET) == 3


def test_a_one_way_cut_is_from_the_first_groups_to_those_after_them() -> None:
    both, one = (Partition(groups=((1,), (2,), (3, 4)), one_way=one_way) for one_way in (False, True))
    assert both.cuts(1, 2)
    assert both.cuts(2, 1)
    assert one.cuts(1, 3)
    assert one.cuts(2, 4)
    assert not one.cuts(3, 1)
    for partition in (both, one):
        assert not partition.cuts(3, 4)
        assert not partition.cuts(5, 1)
        assert not partition.cuts(1, 5)


def life(*events: tuple[str, float]) -> str:
    return "".join(f"[[processes]]\nmav = 2\ndo = '{do}'\nat_s = {at_s}\n" for do, at_s in events)


@pytest.mark.parametrize(
    "events",
    [
        [("kill", 1), ("restart", 2), ("kill", 3), ("restart", 4)],
        [("restart", 2), ("kill", 1)],  # in whatever order they are written
        [("stop", 1), ("continue", 2), ("stop", 3), ("kill", 4), ("restart", 5)],
        [("join", 1), ("stop", 2)],
    ],
)
def test_lives_that_make_sense(events: list[tuple[str, float]]) -> None:
    read(life(*events))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("los = 0.1", "faults.los: there is no such key"),
        ("loss = 'much'", "faults.loss = 'much': expected float, got str"),
        ("loss = 1.1", "faults.loss = 1.1: expected a share, 0 to 1"),
        ("burst_loss = -0.1", "faults.burst_loss = -0.1: expected a share, 0 to 1"),
        ("burst_s = 0.0", "faults.burst_s = 0.0: expected 0.001 to 3600 s"),
        ("delay_ms = 60001", "faults.delay_ms = 60001.0: expected 0 to 60000 ms"),
        ("jitter_ms = -1", "faults.jitter_ms = -1.0: expected 0 to 60000 ms"),
        ("jitter = 'normal'", "faults.jitter = 'normal': expected 'uniform' or 'lognormal'"),
        ("duplicates = nan", "faults.duplicates = nan: expected a share, 0 to 1"),
        ("reorder = 2", "faults.reorder = 2.0: expected a share, 0 to 1"),
        ("bandwidth_bytes_s = 1e-300", "faults.bandwidth_bytes_s = 1e-300: expected 1 or more bytes/s"),
        ("delay_ms = 1e300", "faults.delay_ms = 1e+300: expected 0 to 60000 ms"),
        ("topics = []", "faults.topics = []: expected one or both, once each"),
        ("topics = ['odometry', 'odometry']", "expected one or both, once each"),
        ("topics = ['poses']", "faults.topics[0] = 'poses': expected 'odometry' or 'detections'"),
        ("[[links]]\nloss = 2.0", "faults.links[0].loss = 2.0: expected a share, 0 to 1"),
        ("[[links]]\nsenders = [6]", "faults.links[0].senders: there is no MAV 6, expected 1 to 5"),
        ("[[links]]\nreceivers = [0]", "faults.links[0].receivers: there is no MAV 0, expected 1 to 5"),
        ("[[links]]\nfrom_s = -1", "faults.links[0].from_s = -1.0: expected 0 to 86400 s"),
        ("[[links]]\nfrom_s = 1e300", "faults.links[0].from_s = 1e+300: expected 0 to 86400 s"),
        ("[[links]]\nfrom_s = 3\nuntil_s = 3", "faults.links[0].until_s = 3.0: expected after from_s = 3 s"),
        ("[[links]]\nfrom_s = 20", "faults.links[0].from_s = 20: expected before the run ends, at 20 s"),
        (
            "[[links]]\nsenders = [1]\nreceivers = [1]",
            "faults.links[0].receivers = [1]: expected others than the sender",
        ),
        (
            "[[partitions]]\ngroups = [[1], [2]]\nfrom_s = 20",
            "faults.partitions[0].from_s = 20: expected before the run",
        ),
        ("[[partitions]]\nfrom_s = 1", "faults.partitions[0].groups: this key is required"),
        ("[[partitions]]\ngroups = [[1, 2]]", "groups = [[1, 2]]: expected two groups or more"),
        ("[[partitions]]\ngroups = [[1], [1, 2]]", "groups = [[1], [1, 2]]: expected two groups or more, every MAV in"),
        ("[[partitions]]\ngroups = [[1], []]", "groups = [[1], []]: expected two groups"),
        ("[[partitions]]\ngroups = [[1], [9]]", "faults.partitions[0].groups: there is no MAV 9, expected 1 to 5"),
        ("[[partitions]]\ngroups = [[1], [2]]\nkept = true", "faults.partitions[0].kept = True: expected until_s"),
        ("[[partitions]]\ngroups = [[1], [2]]\nkept = true\nuntil_s = 1e300", "kept arrives, at most 86400 s"),
        ("[[processes]]\nmav = 9\ndo = 'kill'\nat_s = 1", "faults.processes[0].mav: there is no MAV 9"),
        ("[[processes]]\nmav = 1\ndo = 'bless'\nat_s = 1", "faults.processes[0].do = 'bless': expected 'kill' or"),
        ("[[processes]]\nmav = 1\ndo = 'kill'", "faults.processes[0].at_s: this key is required"),
        (life(("kill", 20)), "faults.processes[0].at_s = 20: expected before the last tick, at 19.9 s"),
        (life(("kill", -1)), "faults.processes[0].at_s = -1.0: expected 0 to 86400 s"),
        (life(("kill", 1e308)), "faults.processes[0].at_s = 1e+308: expected 0 to 86400 s"),
        (life(("restart", 3)), "do = 'restart' for MAV 2 at 3 s: it is running then, expected killed"),
        (life(("continue", 3)), "do = 'continue' for MAV 2 at 3 s: it is running then, expected stopped"),
        (life(("kill", 3), ("kill", 4)), "processes[1].do = 'kill' for MAV 2 at 4 s: it is killed then, expected run"),
        (life(("kill", 3), ("continue", 4)), "do = 'continue' for MAV 2 at 4 s: it is killed then, expected stopped"),
        (life(("join", 3), ("kill", 2)), "do = 'kill' for MAV 2 at 2 s: it is not yet started then, expected running"),
        (life(("kill", 2), ("join", 3)), "it is not yet started then"),
        (life(("kill", 3), ("restart", 3.0)), "something happens to it in the same tick already"),
    ],
)
def test_what_makes_no_sense_is_one_exact_line(text: str, complaint: str) -> None:
    with pytest.raises(BadExperiment) as caught:
        read(text)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)
