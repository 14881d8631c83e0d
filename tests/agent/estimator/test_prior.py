"""What a survey says of a MAV, once it is read."""

import numpy as np
import pytest

from agent.estimator.prior import Prior
from agent.interface.frames import compose

FRAMES = np.array([[1.0, 2, 3, 0.5], [-1, 0, 1, 2.5], [4, 4, 4, -1.0]])


def test_only_who_is_awaited_and_read_is_taken():
    prior = Prior(FRAMES, 0.2, 0.1)
    odometry = np.zeros((3, 4))
    odometry[1] = np.nan
    assert prior.of(odometry) == [0, 2]
    rest = prior.without([0, 2])
    assert rest.of(np.zeros((3, 4))) == [1]
    assert rest.without([1]) is None


@pytest.mark.statistical
def test_poses_agree_with_monte_carlo():
    rng, odometry = np.random.default_rng(0), np.array([[3.0, -1, 0.5, 1.0]] * 3)
    found = Prior(FRAMES, 0.2, 0.01).poses(odometry)
    draws = FRAMES + rng.normal(size=(100_000, 3, 4)) * [0.2, 0.2, 0.2, 0.01]
    poses = compose(draws, np.broadcast_to(odometry, draws.shape))
    for row in range(3):
        assert found.y[row] == pytest.approx(compose(FRAMES[row], odometry[row]))
        block = found.Sigma[4 * row : 4 * row + 4, 4 * row : 4 * row + 4]
        np.testing.assert_allclose(np.cov(poses[:, row].T), block, atol=1e-3)
