"""Do recorded messages end up in the right places, and what is missing as NaN?"""

import numpy as np
import pytest

from agent.interface import messages, topics
from agent.interface.bus import Packet
from deploy.clairvoyant import replay
from deploy.log import read_log
from deploy.recorder import Ledger
from deploy.recording import UNKNOWN, Recording, assemble
from tests.deploy.conftest import Flown


@pytest.fixture(scope="module")
def packets(flown: Flown) -> list[Packet]:
    return read_log(flown.folder / "log.mcap").packets


def assembled(flown: Flown, packets: list[Packet]) -> Recording:
    return assemble(packets, flown.experiment.fleet, read_log(flown.folder / "log.mcap").origin.epoch)


def test_everything_is_there(flown: Flown, packets: list[Packet]) -> None:
    recording = assembled(flown, packets)
    assert (recording.ticks, recording.time_s[-1]) == (40, 3.9)
    assert recording.rejected == {}
    for name in ("truth", "vio", "odometry", "estimates", "covariances", "innovations", "tick_us"):
        assert np.isfinite(getattr(recording, name)).all(), name
    assert (recording.states <= messages.LOCALISED).all()
    assert recording.covariances[3, 0, 1] == pytest.approx(recording.covariances[3, 0, 1].T)
    assert recording.detections.keys() == recording.labels.keys() == {(k, m) for k in range(40) for m in (1, 2, 3)}
    assert all(len(recording.detections[at]) == len(recording.labels[at]) for at in recording.labels)
    assert recording.statuses.keys() == {0, 1, 2, 3}
    assert all(status.final for status in recording.statuses.values())
    assert sum(status.sent for status in recording.statuses.values()) == len(packets)


def test_what_is_lost_is_nan_and_what_is_nonsense_is_counted(flown: Flown, packets: list[Packet]) -> None:
    lost = [topics.key(topics.ESTIMATE, 2), topics.key(topics.ODOMETRY, 3), topics.key(topics.STATUS, 2)]
    kept = [packet for packet in packets if packet.key not in lost]
    rest = [Packet("truth/1/pose", b"\x00"), Packet("who/knows", b""), Packet("truth/9/pose", kept[1].payload)]
    recording = assembled(flown, kept + rest)
    assert recording.ticks == 40
    assert np.isnan(recording.estimates[:, 1]).all()
    assert (recording.states[:, 1] == UNKNOWN).all()
    assert np.isfinite(recording.estimates[:, [0, 2]]).all()
    assert np.isnan(recording.odometry[:, 2]).all()
    assert sum(recording.rejected.values()) == 3


def test_a_run_that_broke_off_is_as_long_as_its_truth(flown: Flown, packets: list[Packet]) -> None:
    recording = assembled(flown, packets[: len(packets) // 2])
    assert 15 < recording.ticks < 25
    assert len(recording.truth) == len(recording.estimates) == recording.ticks
    assert assembled(flown, []).ticks == 0


def test_the_clairvoyant_is_fed_as_the_agents_are(flown: Flown, packets: list[Packet]) -> None:
    """Told nothing, the replay must be the agents' own estimates to the last bit: same inputs, same order."""
    recording = assembled(flown, packets)
    twin = replay(recording, flown.experiment.agent, told=False)
    assert twin.estimates.tobytes() == recording.estimates.tobytes()
    assert twin.states.tobytes() == recording.states.tobytes()
    assert not np.array_equal(replay(recording, flown.experiment.agent).estimates, recording.estimates)


def test_the_ledger_knows_what_is_missing(packets: list[Packet], flown: Flown) -> None:
    epoch = read_log(flown.folder / "log.mcap").origin.epoch
    ledger, senders = Ledger(epoch), range(4)
    assert [words.partition(":")[0] for words in ledger.missing(senders)] == ["world", "mav_1", "mav_2", "mav_3"]
    dropped = next(packet for packet in packets if packet.key == "air/2/odometry")
    for packet in packets:
        if packet is not dropped:
            sender = topics.parse(packet.key)[1]
            ledger.enter(packet, 0 if packet.key.startswith(("sensor/", "truth/")) else sender)
    total = sum(packet.key.split("/")[0] in ("air", "command", "belief", "status") for packet in packets) // 3
    assert ledger.missing(senders) == [f"mav_2: 1 of {total} messages"]
