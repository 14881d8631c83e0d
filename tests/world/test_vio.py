"""Does simulated odometry drift as stated, and by nothing else?"""

import numpy as np
import pytest

from agent.interface.fleet import Fleet
from agent.interface.frames import relative_pose, rotation_matrix, wrap, yaw_of
from agent.interface.sensors import Odometry
from world.poses import Poses, turn_z
from world.vio import Vio

QUIET = Odometry(position_sigma_m=0.0, yaw_sigma_rad=0.0)


def random_walk(mavs: int, ticks: int, seed: int = 0) -> list[Poses]:
    """True poses that wander, turn, roll and pitch."""
    draw = np.random.default_rng(seed)
    positions = np.cumsum(draw.normal(0, 0.1, (ticks, mavs, 3)), axis=0)
    yaws = np.cumsum(draw.normal(0, 0.3, (ticks, mavs)), axis=0)
    tilts = draw.normal((0, 0, 0, 1), 0.2, (ticks, mavs, 4))
    tilts /= np.linalg.norm(tilts, axis=-1, keepdims=True)
    return [Poses(p, turn_z(yaw, tilt)) for p, yaw, tilt in zip(positions, yaws, tilts, strict=True)]


def test_without_noise_it_is_the_truth_seen_from_the_start() -> None:
    flown = random_walk(3, 50)
    vio = Vio(QUIET, Fleet(mavs=3), flown[0])
    assert (vio.poses.position == 0).all()
    np.testing.assert_allclose(yaw_of(vio.poses.quaternion), 0, atol=1e-12)
    for true in flown[1:]:
        vio.advance(true)
        expected = relative_pose(vio.pose_world_odom, true.level)
        np.testing.assert_allclose(vio.poses.level[:, :3], expected[:, :3], atol=1e-12)
        np.testing.assert_allclose(wrap(vio.poses.level[:, 3] - expected[:, 3]), 0, atol=1e-12)


def test_roll_and_pitch_stay_true() -> None:
    flown = random_walk(3, 20)
    vio = Vio(Odometry(), Fleet(mavs=3), flown[0])
    for true in flown[1:]:
        vio.advance(true)
        down_read, down_true = (rotation_matrix(each.quaternion)[:, 2] for each in (vio.poses, true))
        np.testing.assert_allclose(down_read, down_true, atol=1e-12)  # where gravity is in the body


@pytest.mark.statistical
def test_drift_is_a_random_walk_of_the_stated_size() -> None:
    mavs, ticks, sigmas = 50, 400, np.array([0.01, 0.01, 0.01, 0.002])
    resting = Poses(np.zeros((mavs, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (mavs, 1)))
    vio = Vio(Odometry(), Fleet(mavs=mavs, seed=4), resting)
    readings = [vio.poses.level]
    for _ in range(ticks):
        vio.advance(resting)
        readings.append(vio.poses.level)
    errors = np.array(readings)
    for after in (100, 400):
        ratio = (errors[after] ** 2).mean(axis=0) / (after * sigmas**2)  # 50 samples: 20 % standard deviation
        assert ((ratio > 0.5) & (ratio < 1.7)).all()
        assert not ((ratio * 3 > 0.5) & (ratio * 3 < 1.7)).any(), "a drift of three times the variance must fail"
    steps = relative_pose(errors[:-1], errors[1:])
    np.testing.assert_allclose(steps.std(axis=(0, 1)) / sigmas, 1, atol=0.02)
    lagged = (steps[:-1] * steps[1:]).mean(axis=(0, 1)) / sigmas**2
    np.testing.assert_allclose(lagged, 0, atol=0.03)  # increments are independent
    assert abs(np.corrcoef(steps[:, 0, 0], steps[:, 1, 0])[0, 1]) < 0.2  # and so are MAVs
