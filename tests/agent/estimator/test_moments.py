"""Closed-form moments against Monte Carlo, and the linear form against the closed one where it is used."""

import numpy as np
import pytest

from agent.estimator.moments import DetectionGeometry, detection_moments, pose_moments, turned_vectors
from agent.estimator.state import Poses, State, poses_jacobian
from agent.interface.frames import rotate_z


def random_state(rng, yaw_sigma, bodies=4):
    P = rng.normal(size=(8 * bodies, 8 * bodies))
    P = P @ P.T / (8 * bodies)
    scale = np.tile([0.2, 0.2, 0.2, yaw_sigma, 0.3, 0.3, 0.3, yaw_sigma], bodies)
    P = P * np.outer(scale, scale)
    x = rng.normal(size=(bodies, 8)) * 2
    return State(x.ravel(), P, station=1)


@pytest.mark.statistical
@pytest.mark.parametrize("yaw_sigma", [0.1, 0.3, 0.6])
def test_turned_vectors_agree_with_monte_carlo(yaw_sigma):
    rng = np.random.default_rng(1)
    n = 3
    A = rng.normal(size=(4 * n, 4 * n)) / 4
    scale = np.tile([0.5, 0.5, 0.5, yaw_sigma], n)
    cov = A @ A.T * np.outer(scale, scale)
    theta, q = rng.normal(size=n), rng.normal(size=(n, 3)) * 3
    draws = rng.multivariate_normal(np.column_stack([q, theta]).ravel(), cov, 400_000).reshape(-1, n, 4)
    turned = rotate_z(draws[..., 3], draws[..., :3]).reshape(-1, 3 * n)
    exact = turned_vectors(theta, q, cov)
    np.testing.assert_allclose(exact.mean.ravel(), turned.mean(0), atol=0.01)
    sampled = np.cov(turned.T)
    assert np.abs(exact.cov - sampled).max() < 0.01 * np.abs(sampled).max()


@pytest.mark.statistical
def test_pose_and_detection_moments_agree_with_monte_carlo():
    rng = np.random.default_rng(2)
    state = random_state(rng, 0.3)
    draws = rng.multivariate_normal(state.x, state.P, 300_000).reshape(-1, 4, 8)
    body = rotate_z(draws[..., 7], draws[..., :3]) + draws[..., 4:7]
    y = np.concatenate([body, draws[..., 3:4]], axis=2).reshape(-1, 16)
    moments = pose_moments(state)
    sampled = np.cov(y.T)
    assert np.abs(moments.poses.Sigma - sampled).max() < 0.01 * np.abs(sampled).max()
    np.testing.assert_allclose(moments.poses.y, y.mean(0), atol=0.01)
    cross = (draws.reshape(-1, 32) - state.x).T @ (y - y.mean(0)) / len(y)
    assert np.abs(moments.P_xy - cross).max() < 0.01 * np.abs(cross).max()

    poses = Poses(moments.poses.y, moments.poses.Sigma)
    draws = rng.multivariate_normal(poses.y, poses.Sigma, 300_000).reshape(-1, 4, 4)
    lines = draws[:, [0, 1], :3] - draws[:, 2:3, :3]
    h = rotate_z(-(draws[:, 2:3, 3] - poses.by_body[2, 3]), lines).reshape(-1, 6)
    detection = detection_moments(poses, DetectionGeometry(4, station=3))
    sampled = np.cov(h.T)
    assert np.abs(detection.P_zz - sampled).max() < 0.01 * np.abs(sampled).max()
    np.testing.assert_allclose(detection.z_hat.ravel(), h.mean(0), atol=0.01)
    cross = (draws.reshape(-1, 16) - poses.y).T @ (h - h.mean(0)) / len(h)
    assert np.abs(detection.P_yz - cross).max() < 0.01 * np.abs(cross).max()


@pytest.mark.parametrize("seed", range(5))
def test_the_linear_form_is_close_where_it_takes_over(seed):
    state = random_state(np.random.default_rng(seed), 0.02)
    linear = pose_moments(state)
    assert state.P[7::8, 7::8].diagonal().max() <= 1e-3
    B = poses_jacobian(state)
    np.testing.assert_allclose(linear.poses.Sigma, B @ state.P @ B.T)
    turned = turned_vectors(state.by_body[:, 7], state.by_body[:, :3], _arm_covariance(state))
    arms = linear.poses.by_body[:, :3] - state.by_body[:, 4:7]
    np.testing.assert_allclose(arms, turned.mean, atol=2e-3)


def _arm_covariance(state):
    entries = np.arange(len(state.x)).reshape(-1, 8)[:, [0, 1, 2, 7]].ravel()
    return state.P[np.ix_(entries, entries)]
