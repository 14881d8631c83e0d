"""What happens in one process when links are bad, and when agents are killed, stopped and started anew?"""

from typing import Any

import numpy as np
import pytest

from agent.interface import messages, topics
from agent.interface.bus import Packet
from deploy import composition, study, summary
from deploy.clairvoyant import replay
from deploy.experiment import Experiment, load
from deploy.faults import Faults, parse
from deploy.recording import GONE, ProcessFault, Recording, assemble

EPOCH = 2**30
TICKS = 45
MAVS = 4


def experiment(seed: int = 5, **faults: Any) -> Experiment:
    changes = [f"fleet.mavs={MAVS}", f"fleet.duration_s={TICKS / 10}"]
    loaded = load("cold_start", changes, seed=seed)
    return loaded._replace(faults=parse(faults, loaded.fleet))


def flown(wanted: Experiment) -> list[Packet]:
    packets: list[Packet] = []
    composition.fly(wanted, EPOCH, packets.extend)
    return packets


def recorded(wanted: Experiment) -> Recording:
    return assemble(flown(wanted), wanted.fleet, EPOCH)


def process_faults(*events: tuple[int, str, float]) -> list[dict[str, Any]]:
    return [{"mav": mav, "do": do, "at_s": at_s} for mav, do, at_s in events]


def untimed(packets: list[Packet]) -> list[Packet]:
    """Without those that say what a tick has cost."""
    return [packet for packet in packets if not packet.key.startswith("status/")]


@pytest.fixture(scope="module")
def perfect() -> Recording:
    return recorded(experiment())


BAD = {"loss": 0.2, "delay_ms": 80, "jitter_ms": 60, "duplicates": 0.1, "reorder": 0.1}


def test_the_same_seed_gives_the_same_faults_and_the_same_estimates() -> None:
    first, second, other = (flown(experiment(seed, **BAD)) for seed in (5, 5, 6))
    assert untimed(first) == untimed(second)
    arrivals = [[packet for packet in packets if packet.key.startswith("fault/")] for packets in (first, other)]
    assert arrivals[0] != arrivals[1]


def test_what_is_lost_on_the_way_is_in_the_journal_and_what_the_agents_do_is_not_disturbed(perfect: Recording) -> None:
    recording = recorded(experiment(loss=0.3))
    for name in ("truth", "odometry"):
        assert getattr(recording, name).tobytes() == getattr(perfect, name).tobytes()
    assert np.diag(recording.dropped).tolist() == [0] * MAVS
    sent = 2 * TICKS
    for k in (0, TICKS - 1):
        assert all(each.tick == k for each in recording.arrivals[k, 1])
    for i in range(MAVS):
        for j in set(range(MAVS)) - {i}:
            arrived = [each for k in range(TICKS) for each in recording.arrivals[k, i + 1] if each.sender == j + 1]
            assert len(arrived) + recording.dropped[i, j] == sent
            assert 0.15 < recording.dropped[i, j] / sent < 0.45
    assert recording.statuses[1].received < 2 * TICKS * MAVS
    assert perfect.arrivals == {}


def test_a_killed_agent_says_nothing_and_its_successor_begins_anew(perfect: Recording) -> None:
    recording = recorded(experiment(processes=process_faults((2, "kill", 1.5), (2, "restart", 2.5))))
    assert recording.process_faults == [ProcessFault(15, 2, "kill"), ProcessFault(25, 2, "restart")]
    lives = recording.incarnations[:, 1]
    assert (set(lives[:15]), set(lives[15:25]), set(lives[25:])) == ({0}, {GONE}, {1})
    assert set(recording.incarnations[:, [0, 2, 3]].ravel()) == {0}
    spoke = np.isfinite(recording.odometry).all(axis=2)
    assert not spoke[15:25, 1].any()
    assert spoke[:15, 1].all()
    assert spoke[25:, 1].all()
    assert spoke[:, [0, 2, 3]].all()
    np.testing.assert_allclose(recording.odometry[25, 1], 0, atol=1e-12)
    assert recording.odometry[:15].tobytes() == perfect.odometry[:15].tobytes()
    assert [status.sender for status in recording.former_statuses] == [2]
    assert recording.statuses[2].final
    answered = recording.beliefs.states[:, :, 0] != 255
    assert answered.tolist() == spoke.tolist()


def test_a_late_joiner_is_not_there_before() -> None:
    recording = recorded(experiment(processes=process_faults((3, "join", 2.0))))
    assert set(recording.incarnations[:20, 2]) == {GONE}
    assert set(recording.incarnations[20:, 2]) == {0}
    assert not np.isfinite(recording.odometry[:20, 2]).any()
    np.testing.assert_allclose(recording.odometry[20, 2], 0, atol=1e-12)


def test_a_stopped_agent_lives_through_what_it_missed_when_it_continues() -> None:
    stops = process_faults((2, "stop", 1.0), (2, "continue", 2.0), (3, "stop", 1.5), (3, "continue", 2.0))
    packets = flown(experiment(processes=stops))
    recording = assemble(packets, experiment().fleet, EPOCH)
    assert set(recording.incarnations[10:20, 1]) == {GONE} == set(recording.incarnations[15:20, 2])
    assert np.isfinite(recording.odometry).all()  # late, but it is said
    assert recording.statuses[2].final
    keys = [packet.key for packet in packets]
    rolls = [k for k, key in enumerate(keys) if key == "sensor/1/roll"]
    assert len(rolls) == 4
    during = keys[rolls[2] : rolls[3]]
    assert topics.key(topics.ODOMETRY, 2) not in during
    assert during.count(topics.key(topics.ODOMETRY, 1)) == 5
    late = [each for k, mav in recording.arrivals for each in recording.arrivals[k, mav] if each.tick < k and mav == 1]
    assert {(each.sender, each.tick) for each in late} == {
        *((2, k) for k in range(10, 20)), *((3, k) for k in range(15, 20)),
    }  # fmt: skip


def test_two_that_stop_and_continue_together_do_not_wait_for_each_other() -> None:
    events = [(mav, do, at_s) for mav in (1, 2, 3, 4) for do, at_s in (("stop", 1.0), ("continue", 1.5))]
    stops = process_faults(*events)
    recording = recorded(experiment(processes=stops, loss=0.2))
    assert (recording.beliefs.states[:, range(MAVS), range(MAVS)] == messages.LOCALISED).all()


def test_everybody_may_be_dead() -> None:
    recording = recorded(experiment(processes=process_faults(*((mav, "kill", 1.0) for mav in range(1, MAVS + 1)))))
    assert recording.ticks == TICKS
    assert set(recording.incarnations[10:].ravel()) == {GONE}


def summarised(recording: Recording, wanted: Experiment) -> dict[str, Any]:
    analysis = summary.analyse(recording, replay(recording, wanted.agent), wanted.faults)
    return summary.summarise(analysis, summary.Circumstances("made", "memory", 1.0))


def test_the_summary_counts_what_the_faults_did() -> None:
    wanted = experiment(loss=0.2, processes=process_faults((2, "kill", 1.0), (2, "restart", 1.5), (3, "join", 0.5)))
    content = summarised(recorded(wanted), wanted)
    assert content["network"]["dropped_by_faults"] > 100
    assert [mav["restarts"] for mav in content["mavs"]] == [0, 1, 0, 0]
    assert [(each["mav"], each["do"], each["at_s"]) for each in content["late_starts"]] == [
        (3, "join", 0.5),
        (2, "restart", 1.5),
    ]
    assert content["across_cuts"] is None


def test_pairs_that_are_cut_off_are_scored_apart_beside_dead_reckoning_from_the_cut(perfect: Recording) -> None:
    cut = {"groups": [[1, 2], [3, 4]], "from_s": 4.0}
    wanted = experiment(partitions=[cut])
    content = summarised(recorded(wanted), wanted)
    assert content["across_cuts"].keys() == {"ours", "clairvoyant", "naive"}
    assert 0 < content["across_cuts"]["naive"]["rmse_m"] < 0.1  # of half a second
    assert content["across_cuts"]["naive"]["rmse_m"] < content["naive"]["relative"]["rmse_m"]
    assert summarised(perfect, experiment())["across_cuts"] is None


def test_the_clairvoyant_knows_those_who_begin_anew() -> None:
    wanted = experiment(processes=process_faults((2, "kill", 1.5), (2, "restart", 2.0), (3, "join", 1.0)))
    recording = recorded(wanted)
    twin = replay(recording, wanted.agent)
    assert (twin.states[-1] == messages.LOCALISED).all()
    analysis = summary.analyse(recording, twin, wanted.faults)
    assert np.nanmax(analysis.clairvoyant.relative.position_m[-1]) < 0.3
    assert (twin.states[15:20, 1] == 255).all()


def test_a_study_over_faults() -> None:
    jobs = study.jobs("cold_start", ["fleet.mavs=3", "fleet.duration_s=1"], range(1), ["faults.loss=0,0.5"])
    dropped = [study.run_one(job)["network"]["dropped_by_faults"] for job in jobs]
    assert dropped[0] == 0 < dropped[1]


def test_no_fault_is_no_fault() -> None:
    assert not Faults().present
    plain, nothing = experiment(), experiment(loss=0.0)
    assert untimed(flown(plain)) == untimed(flown(nothing))
