"""Does the swarm fly over a real network: two hosts, a link that delays and loses, tcp and udp?"""

import json

import pytest

from deploy.experiment import load
from deploy.fleet import Place, names
from deploy.run import run
from deploy.supervisor import Outcome
from deploy.terminal import Quiet
from tests.system.link import Link, why_not

pytestmark = pytest.mark.system
TICKS = 40
EXPERIMENT = f"""
[fleet]
mavs = 3
duration_s = {TICKS / 10}
seed = 5
realtime = true
[[world.path]]
formation = "box"
size_m = [6.0, 6.0, 2.0]
hold_s = 10.0
"""


class Worsening(Quiet):
    """The link loses packets as soon as everybody has met."""

    def __init__(self, link, loss):
        self.link, self.loss = link, loss

    def show(self, progress):
        if progress.sim_s > 0:
            self.link.change(loss=self.loss)


@pytest.fixture(scope="module")
def link():
    if reason := why_not():
        pytest.skip(reason)
    with Link() as link:
        yield link


@pytest.mark.parametrize(("protocol", "loss"), [("tcp", 0.05), ("udp", 0.1)])
def test_three_mavs_on_two_hosts_end_in_the_metrics_of_any_run(link, protocol, loss, tmp_path):
    (tmp_path / "apart.toml").write_text(EXPERIMENT)
    experiment = load(str(tmp_path / "apart.toml"))
    places = {}
    for port, name in enumerate(names(experiment.fleet), start=7450):
        side = int(name in ("mav_2", "mav_3"))
        places[name] = Place(f"{protocol}/{link.addresses[side]}:{port}", inside=link.inside(side))
    link.change(delay_ms=20, loss=0.0)
    outcome, summary = run(experiment, tmp_path / "run", False, Worsening(link, loss), places)
    assert outcome == Outcome()
    assert summary == json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["mode"], summary["transport"], summary["agents"]) == ("realtime", "zenoh", 3)
    assert summary["ticks"] == TICKS
    assert [mav["state"] for mav in summary["mavs"]] == ["localised"] * 3
    assert summary["network"]["rejected"] == 0
