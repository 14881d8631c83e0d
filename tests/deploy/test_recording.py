"""Do recorded messages end up in the right places, and what is missing as NaN?"""

from dataclasses import replace

import numpy as np
import pytest

from agent.interface import messages, topics
from agent.interface.bus import Packet
from agent.interface.frames import compose, relative_pose
from deploy import composition
from deploy.clairvoyant import replay
from deploy.experiment import load
from deploy.log import read_log
from deploy.recorder import Ledger
from deploy.recording import UNKNOWN, Beliefs, Recording, assemble
from tests.deploy.conftest import EXPERIMENT, SMALL, TICKS, Flown, registration


@pytest.fixture(scope="module")
def packets(flown: Flown) -> list[Packet]:
    return read_log(flown.folder / "log.mcap").packets


def assembled(flown: Flown, packets: list[Packet]) -> Recording:
    return assemble(packets, flown.experiment.fleet, read_log(flown.folder / "log.mcap").origin.epoch)


def test_everything_is_there(recording: Recording, packets: list[Packet]) -> None:
    assert (recording.ticks, recording.time_s[-1]) == (TICKS, (TICKS - 1) / 10)
    assert recording.rejected == {}
    for name in ("truth", "vio", "odometry", "wanted", "covariances", "innovations", "tick_us"):
        assert np.isfinite(getattr(recording, name)).all(), name
    assert np.isfinite(recording.beliefs.estimates).all()
    assert (recording.beliefs.states <= messages.LOCALISED).all()
    assert (recording.beliefs.starts[0] != recording.beliefs.starts[-1]).any(axis=1).all()  # odometry drifts
    assert recording.covariances[3, 0, 1] == pytest.approx(recording.covariances[3, 0, 1].T)
    assert recording.detections.keys() == recording.labels.keys() == {(k, m) for k in range(TICKS) for m in (1, 2, 3)}
    assert all(len(recording.detections[at]) == len(recording.labels[at]) for at in recording.labels)
    assert recording.statuses.keys() == {0, 1, 2, 3}
    assert all(status.final for status in recording.statuses.values())
    assert sum(status.sent for status in recording.statuses.values()) == len(packets)


def test_what_is_lost_is_nan_and_what_is_nonsense_is_counted(flown: Flown, packets: list[Packet]) -> None:
    lost = [topics.key(topics.ESTIMATE, 2), topics.key(topics.ODOMETRY, 3), topics.key(topics.STATUS, 2)]
    kept = [packet for packet in packets if packet.key not in lost]
    rest = [Packet("truth/1/pose", b"\x00"), Packet("who/knows", b""), Packet("truth/9/pose", kept[1].payload)]
    recording = assembled(flown, kept + rest)
    beliefs = recording.beliefs
    assert recording.ticks == TICKS
    for values in (beliefs.estimates, beliefs.starts, beliefs.absolute):
        assert np.isnan(values[:, 1]).all()
        assert np.isfinite(values[:, [0, 2]]).all()
    assert (beliefs.states[:, 1] == UNKNOWN).all()
    assert np.isnan(recording.odometry[:, 2]).all()
    assert sum(recording.rejected.values()) == 3


def test_the_last_registration_of_each_agent_is_kept(flown: Flown, packets: list[Packet]) -> None:
    epoch = read_log(flown.folder / "log.mcap").origin.epoch
    said = [
        registration(2, epoch, ["why", "", "why"], 3, tick=5),
        registration(2, epoch, ["because", "", ""], 2, tick=7),
        registration(2, epoch, ["overtaken", "", ""], 1, tick=6),
        registration(3, epoch, ["", "", ""], 0, tick=TICKS - 1),
    ]
    wrong = [
        registration(1, epoch, ["", "only two"], 0),
        registration(1, epoch, ["", "", "after the end"], 0, tick=TICKS + 2),
        registration(1, epoch + 1, ["", "", "of another run"], 0),
        registration(9, epoch, ["", "", ""], 0),
    ]
    others = [packet for packet in packets if not packet.key.endswith("/registration")]
    recording = assembled(flown, others + said + wrong)
    assert {mav: last.reasons for mav, last in recording.registrations.items()} == {
        2: ("because", "", ""),
        3: ("", "", ""),
    }
    assert recording.rejected == {"unexpected": 2, "epoch": 1, "mav": 1}


def test_who_has_touched_whom(flown: Flown, packets: list[Packet]) -> None:
    epoch = read_log(flown.folder / "log.mcap").origin.epoch

    def contact(mav: int, *others: int, tick: int = 4) -> Packet:
        header = (messages.VERSION, epoch, 0, tick, tick * 10**8)
        return Packet(topics.key(topics.CONTACT, mav), messages.encode(messages.Contact(*header, mav, bytes(others))))

    assert assembled(flown, packets).touched == set()
    told = [contact(1, 2), contact(2, 1), contact(2, 1, tick=5), contact(3, 2), contact(1, 9)]
    recording = assembled(flown, packets + told)
    assert recording.touched == {(1, 2), (2, 3)}  # one end of it is enough
    assert recording.rejected == {"unexpected": 1}


def test_a_run_that_broke_off_is_as_long_as_its_truth(flown: Flown, packets: list[Packet]) -> None:
    recording = assembled(flown, packets[: len(packets) // 2])
    assert 1 < recording.ticks < TICKS
    assert len(recording.truth) == len(recording.beliefs.estimates) == recording.ticks
    assert assembled(flown, []).ticks == 0


def test_absolute_is_as_seen_from_the_believed_start() -> None:
    """An agent whose odometry has drifted, and knows it, sees everybody from its true start where they are."""
    rng = np.random.default_rng(2)
    true, drift = rng.normal(0, 1, (5, 3, 3, 4)), rng.normal(0, 1, (5, 3, 4))  # from the start; the start in odometry
    estimates = compose(drift[:, :, None], true)
    absolute = Beliefs(np.full((5, 3, 3), messages.LOCALISED, np.uint8), estimates, drift).absolute
    np.testing.assert_allclose(relative_pose(absolute, true), 0, atol=1e-12)


def test_the_clairvoyant_is_fed_as_the_agents_are() -> None:
    """Told nothing, the replay of a surveyed start must be the agents' own estimates to the last bit: same inputs, same
    order."""
    experiment, packets = load(EXPERIMENT, [*SMALL, "world.survey.position_sigma_m=0.2"], seed=5), list[Packet]()
    composition.fly(experiment, 1, packets.extend)
    recording = assemble(packets, experiment.fleet, 1)
    assert recording.surveys.keys() == {1, 2, 3}
    twin, believed = replay(recording, experiment.agent, told=False), recording.beliefs
    for found, expected in zip(twin, believed, strict=True):
        assert found.tobytes() == expected.tobytes()
    assert not np.array_equal(replay(recording, experiment.agent).estimates, believed.estimates)


def test_without_a_survey_the_clairvoyant_begins_from_the_truth(flown: Flown, recording: Recording) -> None:
    assert recording.surveys == {}
    blind = replay(replace(recording, detections={}), flown.experiment.agent)
    true_relative = relative_pose(recording.true_poses[0, :, None], recording.true_poses[0, None])
    np.testing.assert_allclose(relative_pose(blind.estimates[0], true_relative), 0, atol=1e-6)
    assert (blind.states[0] == messages.LOCALISED).sum() == 3  # itself only: of the others a survey's worth
    assert (replay(recording, flown.experiment.agent).states[-1] == messages.LOCALISED).all()


def test_without_a_survey_and_without_the_truth_there_is_no_clairvoyant(flown: Flown, packets: list[Packet]) -> None:
    lost = topics.key(topics.TRUTH, 2)
    twin = replay(assembled(flown, [packet for packet in packets if packet.key != lost]), flown.experiment.agent)
    assert (twin.states == UNKNOWN).all()
    assert np.isnan(twin.estimates).all()


def test_the_ledger_knows_what_is_missing(packets: list[Packet], flown: Flown) -> None:
    epoch = read_log(flown.folder / "log.mcap").origin.epoch
    ledger, senders = Ledger(epoch), range(4)
    assert [words.partition(":")[0] for words in ledger.missing(senders)] == ["world", "mav_1", "mav_2", "mav_3"]
    dropped = next(packet for packet in packets if packet.key == "air/2/odometry")
    for packet in packets:
        if packet is not dropped:
            sender = topics.parse(packet.key)[1]
            ledger.enter(packet, 0 if packet.key.startswith(("sensor/", "truth/")) else sender)
    spoken = ("air/2/", "command/2", "belief/2/", "status/2")
    total = sum(packet.key.startswith(spoken) for packet in packets)
    assert ledger.missing(senders) == [f"mav_2: 1 of {total} messages"]
