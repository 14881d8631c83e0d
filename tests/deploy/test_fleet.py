"""Which processes make a run, and who waits for whom?"""

import json
from pathlib import Path

from agent.interface.fleet import Fleet
from deploy import fleet
from deploy.faults import Faults

FLEET = Fleet(mavs=2)


def table(folder: Path, view: str | None = None) -> tuple[fleet.Process, ...]:
    where = fleet.on_one_host(FLEET, folder)
    return fleet.processes(FLEET, folder, folder, 7, where, Faults(), view)


def test_a_viewer_is_one_more_that_nobody_waits_for(tmp_path: Path) -> None:
    without, with_viewer = table(tmp_path), table(tmp_path, "rerun+http://127.0.0.1:1/proxy")
    assert [row.name for row in without] == ["recorder", "world", "mav_1", "mav_2"]
    assert with_viewer[1:] == without
    viewer = with_viewer[0]
    assert (viewer.name, viewer.ends) == ("viewer", "whenever")
    assert "rerun+http://127.0.0.1:1/proxy" in viewer.command
    for name in ("recorder", "world", "mav_1", "mav_2", "viewer"):
        place = json.loads((tmp_path / f"{name}.json").read_text())
        assert "viewer" not in place["everyone"]
        assert not any(endpoint.endswith("/viewer") for endpoint in place["connect"])
    assert (place["listen"], len(place["connect"])) == ([], 4)


def test_agents_may_not_hear_the_truth(tmp_path: Path) -> None:
    table(tmp_path, "somewhere")
    denied = {
        name: json.loads((tmp_path / f"{name}.json").read_text())["deny"] for name in ("mav_1", "world", "viewer")
    }
    assert denied == {"mav_1": ["truth/**", "fault/**"], "world": [], "viewer": []}
