"""Are recorded flights played as they were, in the right frames, and unusable files refused with exact words?"""

from pathlib import Path

import numpy as np
import pytest

from agent.interface.fleet import Fleet
from agent.interface.frames import compose, inverse, relative_pose, rotate_z, rotation_matrix, wrap
from agent.interface.tables import BadExperiment
from world.poses import Poses, multiply, turn_z
from world.recorded import Flight, RecordedFlights, body_rotation
from world.tracks import Track, read_track

EUROC = Path(__file__).parents[3] / "shared" / "datasets" / "euroc_vio"
X_UP = np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])  # recorded body in ours: its x axis is our z, its z our x
FRAME = np.array([1.0, -2.0, 0.5, 0.7])  # of the odometry in the world
BEGIN_S = 1.4e9


def write(path: Path, time_s: np.ndarray, poses: Poses, separator: str = " ") -> None:
    rows = np.column_stack([time_s, poses.position, poses.quaternion])
    lines = [separator.join(f"{value:.9f}" for value in row) for row in rows]
    path.write_text("# t x y z qx qy qz qw\n\n" + "\n".join(lines) + "\n")


def flown(time_s: np.ndarray) -> Poses:
    """Our body: level yaw that turns, a little roll."""
    t = time_s - BEGIN_S
    roll = np.stack([np.sin(0.05 * np.sin(t)), 0 * t, 0 * t, np.cos(0.05 * np.sin(t))], axis=-1)
    return Poses(np.stack([np.sin(t), np.cos(t), 2 + 0.1 * t], axis=-1), turn_z(0.5 * t, roll))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One flight of 10 s: truth from 0 s at 200 Hz, perfect odometry from 1 s at 20 Hz, both with x up."""
    truth_s, vio_s = BEGIN_S + np.arange(0, 10, 0.005), BEGIN_S + np.arange(1, 10, 0.05)
    true, seen = flown(truth_s), flown(vio_s)
    write(tmp_path / "truth.txt", truth_s, Poses(true.position, multiply(true.quaternion, X_UP)))
    p_odom_body = rotate_z(-FRAME[3], seen.position - FRAME[:3])
    quaternion = multiply(turn_z(np.full(len(vio_s), -FRAME[3]), seen.quaternion), X_UP)
    write(tmp_path / "vio.txt", vio_s, Poses(p_odom_body, quaternion), separator=", ")
    return tmp_path


def play(folder: Path | str | None, duration_s: float = 5.0, **flight: object) -> RecordedFlights:
    fleet = Fleet(mavs=1, duration_s=duration_s)
    return RecordedFlights((Flight(**{"truth": "truth.txt", "vio": "vio.txt"} | flight),), str(folder), fleet)


def test_truth_and_odometry_are_what_was_flown(folder: Path) -> None:
    flight = play(folder, from_s=2.02)
    np.testing.assert_allclose(flight.pose_world_odom, [FRAME], atol=1e-4)
    for tick in range(50):
        if tick:
            flight.step()
        time_s = np.array([BEGIN_S + 3.05 + tick / 10])  # 1 + 2.02 s, then the next VIO row
        level = flown(time_s).level
        level[:, 3] = wrap(level[:, 3])
        assert np.abs(flight.true.position - level[:, :3]).max() < 1e-4
        assert np.abs(wrap(flight.true.level[:, 3] - level[:, 3])).max() < 1e-3
        up = rotation_matrix(flight.true.quaternion)[0, 2]
        np.testing.assert_allclose(up, rotation_matrix(flown(time_s).quaternion)[0, 2], atol=0.03)
        seen = compose(np.array([FRAME]), flight.vio.level)
        assert np.abs(relative_pose(seen, flight.true.level)).max() < 1e-3


def test_poses_between_rows_are_interpolated(folder: Path) -> None:
    fleet = Fleet(mavs=1, duration_s=4.0, rate_hz=30)
    flight = RecordedFlights((Flight("truth.txt", "vio.txt"),), str(folder), fleet)
    for tick in range(100):
        if tick:
            flight.step()
        expected = flown(np.array([BEGIN_S + 1.0 + tick / 30])).level
        assert np.abs(relative_pose(expected, flight.true.level)).max() < 2e-3
        assert np.abs(relative_pose(expected, compose(np.array([FRAME]), flight.vio.level))).max() < 2e-3


def test_a_body_that_is_level_is_left_as_it_is() -> None:
    yaws = turn_z(np.linspace(0, 6, 50), np.tile([0.0, 0.0, 0.0, 1.0], (50, 1)))
    track = Track(Path("x"), np.arange(50.0), Poses(np.zeros((50, 3)), yaws))
    np.testing.assert_allclose(body_rotation(track), [0, 0, 0, 1], atol=1e-12)


def test_rows_before_the_vio_has_begun_are_left_out(folder: Path) -> None:
    text = (folder / "vio.txt").read_text()
    placeholder = f"{BEGIN_S + 0.5:.6f} 0 0 0 0 0 0 1\n"
    (folder / "vio.txt").write_text(placeholder + text)
    np.testing.assert_allclose(play(folder).true.position, flown(np.array([BEGIN_S + 1.0])).position, atol=1e-4)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1500000000 1 2 3", "line 183: 4 columns, expected 8: t x y z qx qy qz qw"),
        ("1500000000 1 2 x 0 0 0 1", "line 183: could not convert string to float: 'x'"),
        ("1500000000 1 2 nan 0 0 0 1", "line 183: not finite"),
        ("1500000000 1 2 1e7 0 0 0 1", r"line 183: a position beyond 1e\+06 m"),
        ("1500000000 1 2 3 0 0 0 2", "line 183: a quaternion whose length is not 1"),
        ("1400000003 1 2 3 0 0 0 1", "line 183: a time that does not come after the row before"),
    ],
)
def test_malformed_lines(folder: Path, line: str, words: str) -> None:
    with (folder / "vio.txt").open("a") as file:
        file.write(line + "\n")
    with pytest.raises(BadExperiment, match=rf"world.flights\[0\]: .*vio.txt, {words}"):
        play(folder)


def test_unusable_recordings(folder: Path) -> None:
    with pytest.raises(BadExperiment, match=r"flights\[0\]: cannot read .*nothing.txt: No such file or directory"):
        play(folder, truth="nothing.txt")
    with pytest.raises(BadExperiment, match=r"give it with --set world.flights_dir=DIR"):
        RecordedFlights((Flight("truth.txt", "vio.txt"),), None, Fleet(mavs=1))
    with pytest.raises(BadExperiment, match=r"world.flights: 1 flights, expected 7, one per MAV"):
        RecordedFlights((Flight("truth.txt", "vio.txt"),), str(folder), Fleet())
    play(folder, duration_s=8.9)
    with pytest.raises(BadExperiment, match=r"8.9 s from from_s = 1 on are asked for, but .* have 9.0 s in common"):
        play(folder, duration_s=9.0, from_s=1.0)
    for from_s in (-1.0, 50.0):
        with pytest.raises(BadExperiment, match="asked for"):
            play(folder, from_s=from_s)
    (folder / "vio.txt").write_text("# t x y z qx qy qz qw\n")
    with pytest.raises(BadExperiment, match=r"truth.txt or vio.txt holds no poses"):
        play(folder)
    (folder / "vio.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadExperiment, match="is not a text file"):
        play(folder)


def test_long_gaps_are_not_bridged(folder: Path) -> None:
    lines = (folder / "truth.txt").read_text().splitlines()
    (folder / "truth.txt").write_text("\n".join(lines[:602] + lines[722:]))  # 3.0 to 3.6 s are missing
    with pytest.raises(BadExperiment, match=r"truth.txt has a gap of 0.61 s at 1400000002.995 s"):
        play(folder)
    play(folder, from_s=3.0)


@pytest.mark.skipif(not EUROC.is_dir(), reason="the EuRoC recordings are not here")
@pytest.mark.parametrize(
    ("name", "from_s", "yaw_drift_deg", "position_drift_m"),
    [("V2_01", 34.0, 2.0, 0.15), ("V2_02", 48.0, 2.0, 0.2), ("V2_03", 4.0, 4.0, 0.5)],
)
def test_real_flights_agree_with_their_truth(
    name: str, from_s: float, yaw_drift_deg: float, position_drift_m: float
) -> None:
    flight = Flight(f"gt_{name}.txt", f"est_stereo_{name}.txt", from_s)
    fleet = Fleet(mavs=1, duration_s=60.0)
    played = RecordedFlights((flight,), str(EUROC), fleet)
    up = body_rotation(read_track(EUROC / flight.truth, "test"))
    assert np.abs(up - [0.8137, 0.0, 0.5813, 0.0]).max() < 0.005  # the same IMU on the same MAV in all flights
    frame, errors, tilts, steps, before = played.pose_world_odom, [], [], [], None
    for tick in range(fleet.ticks):
        if tick:
            played.step()
        true, read = played.true, played.vio
        errors.append(relative_pose(compose(frame, read.level), true.level)[0])
        down = [rotation_matrix(each.quaternion)[0, 2] for each in (true, read)]
        tilts.append(np.arccos(min(1.0, down[0] @ down[1])))
        assert down[0][2] > 0.85  # never more than 32 deg from level
        if before is not None:
            step_true, step_read = relative_pose(before[0], true.level)[0], relative_pose(before[1], read.level)[0]
            steps.append(step_true - step_read)
        before = (true.level, read.level)
    assert np.linalg.norm(np.array(errors)[:, :3], axis=1).max() < position_drift_m
    assert np.degrees(np.abs(np.array(errors)[:, 3]).max()) < yaw_drift_deg
    assert np.sqrt(np.mean(np.square(tilts))) < 0.035  # gravity-aligned; a wrong body rotation gives over 0.3
    noise = np.array(steps)
    noise[:, 3] = wrap(noise[:, 3])
    assert noise[:, :3].std(axis=0).max() < 0.007
    assert noise[:, 3].std() < 0.0035
    np.testing.assert_allclose(inverse(inverse(frame)), frame, atol=1e-9)


def test_an_odometry_that_begins_anew_is_where_it_is_and_level(folder: Path) -> None:
    flight, undisturbed = play(folder), play(folder)
    for _ in range(10):
        flight.step()
        undisturbed.step()
    begin = flight.vio.level[0]
    flight.begin_odometry(1)
    np.testing.assert_allclose(flight.vio.level, 0, atol=1e-12)
    for _ in range(20):
        flight.step()
        undisturbed.step()
    np.testing.assert_allclose(flight.vio.level[0], relative_pose(begin, undisturbed.vio.level[0]), atol=1e-12)
    for mine, theirs in ((flight.vio, undisturbed.vio), (flight.true, undisturbed.true)):
        tilts = [rotation_matrix(each.quaternion)[:, 2] for each in (mine, theirs)]
        np.testing.assert_allclose(*tilts, atol=1e-12)
