"""Does a scene show what was, and what was believed, at its tick?"""

from pathlib import Path

import numpy as np
import pytest

from agent.interface import messages, topics
from agent.interface.bus import Packet
from agent.interface.fleet import Fleet
from agent.interface.frames import relative_pose
from agent.interface.messages import LOCALISED, SEARCHING
from agent.interface.sensors import Detector
from deploy.log import BadLog, read_log
from deploy.recording import Recording
from deploy.view.scene import Scene, Stage, explained, scenes, stage_of, turned
from tests.deploy.conftest import Flown

EPOCH = 7
FLEET = Fleet(mavs=2, duration_s=2.0)


@pytest.fixture(scope="module")
def shown(flown: Flown) -> list[Scene]:
    return list(scenes(flown.folder))


def test_there_is_one_a_tick_with_the_truth(shown: list[Scene], recording: Recording) -> None:
    np.testing.assert_allclose([scene.time_s for scene in shown], recording.time_s)
    np.testing.assert_array_equal([scene.truth for scene in shown], recording.true_poses)


def test_beliefs_lie_where_they_would_be_if_they_were_true(shown: list[Scene], recording: Recording) -> None:
    last, truth = shown[-1], recording.true_poses[-1]
    assert sorted(last.beliefs) == [1, 2, 3]
    for mav, belief in last.beliefs.items():
        assert (belief.states == LOCALISED).all()
        apart = relative_pose(belief.poses[mav - 1], belief.poses) - relative_pose(truth[mav - 1], truth)
        others = np.linalg.norm(np.delete(apart, mav - 1, axis=0)[:, :3], axis=1)
        assert belief.error_m == pytest.approx(np.sqrt(np.mean(others**2)))
        assert np.linalg.norm(belief.poses[:, :3] - truth[:, :3], axis=1).max() < 0.3  # the odometry has drifted
        spread = np.sqrt(np.linalg.eigvalsh(belief.covariances))
        assert (spread < 0.2).all()


def test_nobody_is_drawn_before_he_is_localised(shown: list[Scene], recording: Recording) -> None:
    unknown = recording.beliefs.states[0] != LOCALISED
    for mav, belief in shown[0].beliefs.items():
        others = np.arange(3) != mav - 1
        assert np.isnan(belief.poses[others & unknown[mav - 1]]).all()
        assert np.isnan(belief.error_m)
        assert not belief.explained.any()  # nobody is there who could explain anything


def test_detections_end_at_those_who_were_detected(shown: list[Scene], recording: Recording) -> None:
    scene = shown[-1]
    true, false = [], []
    for mav, belief in scene.beliefs.items():
        for label, end, weight in zip(
            recording.labels[len(shown) - 1, mav], belief.detected, belief.explained, strict=True
        ):
            (true if label else false).append(weight)
            if label:
                assert np.linalg.norm(end - scene.truth[label - 1, :3]) < 2.5  # range noise grows with the range
    assert true
    assert min(true) > 0.5
    assert all(weight < 0.5 for weight in false)


def test_the_order_in_which_messages_come_does_not_matter(flown: Flown, shown: list[Scene]) -> None:
    log, rng = read_log(flown.folder / "log.mcap"), np.random.default_rng(0)
    stage = stage_of(flown.experiment, log.origin.epoch)
    found: list[Scene] = []
    for first in range(0, len(log.packets), 20):  # less than a tick's
        some = log.packets[first : first + 20]
        for index in rng.permutation(len(some)):
            found += stage.see(some[index])
    found += stage.rest()
    assert len(found) == len(shown)
    for a, b in zip(found, shown, strict=True):
        np.testing.assert_array_equal(a.truth, b.truth)
        for mav in (1, 2, 3):
            np.testing.assert_array_equal(a.beliefs[mav].poses, b.beliefs[mav].poses)


def test_what_is_not_to_be_shown_is_known_all_the_same(flown: Flown, shown: list[Scene]) -> None:
    log = read_log(flown.folder / "log.mcap")
    stage = stage_of(flown.experiment, log.origin.epoch)
    for packet in log.packets:
        assert stage.see(packet, show=False) == []
    last = stage.rest()[-1]
    np.testing.assert_array_equal(last.beliefs[1].poses, shown[-1].beliefs[1].poses)


def test_rubbish_and_other_runs_are_not_seen(flown: Flown) -> None:
    stage = stage_of(flown.experiment, EPOCH)
    log = read_log(flown.folder / "log.mcap")
    for packet in [*log.packets[:50], Packet("truth/1/pose", b"\xc1"), Packet("no/such/topic", b"")]:
        assert stage.see(packet) == []
    assert stage.rest() == []


def packet(topic: topics.Topic, mav: int, tick: int, *fields: object) -> Packet:
    header = (messages.VERSION, EPOCH, mav, tick, FLEET.stamp_ns(tick))
    return Packet(topics.key(topic, mav), messages.encode_fields(topic.kind, *header, *fields))


def truth(mav: int, tick: int, place: list[float]) -> Packet:
    return packet(topics.TRUTH, mav, tick, mav, np.array(place, float).tobytes(), np.array([0, 0, 0, 1.0]).tobytes())


def odometry(mav: int, tick: int, place: list[float]) -> Packet:
    return packet(topics.ODOMETRY, mav, tick, np.array([*place, 0.0]).tobytes())


def estimate(mav: int, tick: int, poses: list[list[float]], states: bytes, start: list[float]) -> Packet:
    covariances = np.zeros((2, 10), "<f4").tobytes()
    return packet(
        topics.ESTIMATE, mav, tick, states, np.array(poses, float).tobytes(), covariances,
        np.array(start, float).tobytes(), 0, 0,
    )  # fmt: skip


def stage(faults: bool = False) -> Stage:
    return Stage(FLEET, EPOCH, Detector(), faults)


def test_an_agent_that_is_started_anew_is_drawn_in_its_new_frame() -> None:
    both = bytes([LOCALISED, LOCALISED])
    seen = stage()
    for tick, own in ((0, 0.0), (1, 1.0)):
        for one in (truth(1, tick, [5 + own, 0, 0]), odometry(1, tick, [own, 0, 0]), truth(2, tick, [9, 0, 0])):
            seen.see(one)
        seen.see(estimate(1, tick, [[own, 0, 0, 0], [4, 0, 0, 0]], both, [0, 0, 0, 0]))
    roll = packet(topics.ROLL, 1, 2, bytes([1, 2]), (1, 0))
    for one in (roll, truth(1, 2, [7, 0, 0]), odometry(1, 2, [0, 0, 0]), truth(2, 2, [9, 0, 0])):
        seen.see(one)
    seen.see(estimate(1, 2, [[0, 0, 0, 0], [2, 0, 0, 0]], both, [0, 0, 0, 0]))
    found = [scene.beliefs[1].poses[:, 0].tolist() for scene in seen.rest()]
    assert found == [[5, 9], [6, 9], [7, 9]]


def test_drift_that_an_agent_knows_of_is_taken_out() -> None:
    seen = stage()
    for one in (truth(1, 0, [5, 0, 0]), odometry(1, 0, [0, 0, 0]), truth(1, 1, [5, 0, 0]), odometry(1, 1, [0.5, 0, 0])):
        seen.see(one)
    # It has stood still: it is where it began, of which it knows that it lies half a metre on in its frame by now.
    seen.see(estimate(1, 1, [[0.5, 0, 0, 0], [0, 0, 0, 0]], bytes([LOCALISED, SEARCHING]), [0.5, 0, 0, 0]))
    belief = seen.rest()[-1].beliefs[1]
    assert belief.poses[0].tolist() == [5, 0, 0, 0]
    assert np.isnan(belief.poses[1]).all()


def test_without_a_world_beliefs_stay_in_their_own_frames() -> None:
    seen = stage()
    seen.see(estimate(2, 0, [[1, 2, 3, 0], [0, 0, 0, 0]], bytes([LOCALISED, LOCALISED]), [0, 0, 0, 0]))
    (scene,) = seen.rest()
    assert scene.beliefs[2].poses[0].tolist() == [1, 2, 3, 0]
    assert np.isnan(scene.truth).all()


def test_rivals_are_drawn_with_their_weights() -> None:
    seen = stage()
    seen.see(estimate(1, 0, [[0, 0, 0, 0], [0, 0, 0, 0]], bytes([LOCALISED, SEARCHING]), [0, 0, 0, 0]))
    placed = np.array([[1, 1], [1, 0]], np.uint8)
    poses = np.zeros((2, 2, 4), "<f4")
    poses[0, 1, 0] = 3
    fields = (("", "why"), np.array([0.7, 0.3]).tobytes(), placed.tobytes(), poses.tobytes())
    seen.see(packet(topics.REGISTRATION, 1, 0, *fields))
    belief = seen.rest()[0].beliefs[1]
    assert belief.rival_weights.tolist() == [0.7, 0.3]
    assert belief.rivals[0, 1].tolist() == [3, 0, 0, 0]
    assert np.isnan(belief.rivals[1, 1]).all()


def test_links_age_by_what_arrived() -> None:
    perfect, faulty = stage(), stage(faults=True)
    arrivals = packet(topics.ARRIVALS, 1, 0, bytes([2]), bytes([0]), np.array([0], "<i8").tobytes(), (0, 0))
    for seen in (perfect, faulty):
        for one in (odometry(1, 0, [0, 0, 0]), odometry(2, 0, [0, 0, 0]), arrivals, odometry(2, 2, [0, 0, 0])):
            seen.see(one)
    assert [scene.ages_s[0, 1] for scene in perfect.rest()] == [0, 0]
    late = faulty.rest()[-1].ages_s
    assert late[0, 1] == pytest.approx(0.2)
    assert np.isnan(late[1, 0])


def test_a_detection_is_explained_by_who_is_believed_to_be_there() -> None:
    detector, places, spread = Detector(), np.array([[3.0, 0, 0], [0, 4.0, 0]]), np.full((2, 3, 3), 0.0)
    vectors = np.array([[3.0, 0, 0], [-3.0, 0, 0], [3.3, 0, 0], [3.0, 0.5, 0]])
    weights = explained(vectors, places, spread, detector)
    assert weights[0] > 0.99
    assert weights[1] < 1e-9
    assert weights[2] > 0.9  # the range is the least exact ...
    assert weights[3] < 1e-9  # ... the bearing is not
    assert explained(vectors, places[:0], spread[:0], detector).tolist() == [0, 0, 0, 0]
    assert explained(vectors[:0], places, spread, detector).shape == (0,)


def test_explaining_agrees_with_the_definition() -> None:
    """The plain form: one target, Bayes' rule with the density of clutter."""
    detector, place = Detector(P_D=0.6, false_per_set=3.0), np.array([2.0, 1.0, -1.0])
    P = np.diag([0.01, 0.02, 0.03])
    along = np.outer(place, place) / (place @ place)
    distance = np.linalg.norm(place)
    S = P + float(detector.range_sigma_m(distance)) ** 2 * along
    S += (detector.bearing_sigma_rad * distance) ** 2 * (np.eye(3) - along)
    nu = np.array([0.1, -0.1, 0.05])
    density = np.exp(-0.5 * nu @ np.linalg.solve(S, nu)) / np.sqrt(np.linalg.det(2 * np.pi * S))
    expected = detector.P_D * density / (detector.P_D * density + detector.clutter_density)
    assert explained((place + nu)[None], place[None], P[None], detector)[0] == pytest.approx(expected, rel=1e-9)


def test_covariances_turn_with_their_frame() -> None:
    found = turned(np.pi / 2, np.diag([4.0, 1.0, 9.0]))
    np.testing.assert_allclose(found, np.diag([1.0, 4.0, 9.0]), atol=1e-12)
    c, s = np.cos(0.3), np.sin(0.3)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    A = np.random.default_rng(0).normal(size=(2, 3, 3))
    P = A @ A.swapaxes(1, 2)
    np.testing.assert_allclose(turned(0.3, P), R @ P @ R.T)


def test_a_folder_without_a_log_is_said(tmp_path: Path) -> None:
    with pytest.raises(BadLog, match="No such file"):
        next(scenes(tmp_path))
