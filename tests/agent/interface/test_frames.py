"""Frames: the algebra that everything else stands on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from agent.interface import frames as f

poses = st.tuples(*[st.floats(-50, 50)] * 3, st.floats(-3, 3)).map(np.array)


@given(poses, poses)
def test_relative_pose_undoes_compose(a, b):
    np.testing.assert_allclose(f.relative_pose(a, f.compose(a, b)), b, atol=1e-9)


@given(poses)
def test_inverse(a):
    np.testing.assert_allclose(f.compose(a, f.inverse(a)), np.zeros(4), atol=1e-9)


@given(st.floats(-100, 100))
def test_wrap(angle):
    wrapped = float(f.wrap(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_rotations_agree_with_scipy(seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(4, rng=rng)
    q = rotation.as_quat()
    np.testing.assert_allclose(f.rotation_matrix(q), rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(f.yaw_of(q), rotation.as_euler("ZYX")[:, 0], atol=1e-12)
    yaws, vectors = rng.uniform(-3, 3, 4), rng.normal(size=(4, 3))
    expected = Rotation.from_euler("z", yaws[:, None]).apply(vectors)
    np.testing.assert_allclose(f.rotate_z(yaws, vectors), expected, atol=1e-12)


def test_rotate_z_broadcasts():
    vectors = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(f.rotate_z(0.3, vectors)[2], f.rotate_z(0.3, vectors[2]))
    assert f.rotate_z(np.zeros((2, 1)), vectors).shape == (2, 5, 3)


@pytest.mark.parametrize("seed", range(3))
def test_spherical_round_trip(seed):
    vectors = np.random.default_rng(seed).normal(size=(6, 3)) * 5
    spherical = f.range_and_bearing(vectors)
    np.testing.assert_allclose(spherical[:, :1] * f.direction(spherical[:, 1], spherical[:, 2]), vectors, atol=1e-12)
