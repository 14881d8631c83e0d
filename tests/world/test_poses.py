"""Does the arithmetic of rotations equal its plain twins?"""

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from agent.interface.frames import rotation_matrix
from world.poses import multiply, quaternion_of, rotations, slerp, turn_z


def quaternions(count: int, seed: int) -> np.ndarray:
    drawn = np.random.default_rng(seed).standard_normal((count, 4))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def test_products_are_hamiltons() -> None:
    a, b = quaternions(30, 5), quaternions(30, 6)
    (*p, v), (*q, w) = a.T, b.T
    p, q = np.array(p), np.array(q)
    expected = np.vstack([v * q + w * p + np.cross(p.T, q.T).T, v * w - (p * q).sum(axis=0)]).T
    np.testing.assert_allclose(multiply(a, b), expected, atol=1e-15)
    np.testing.assert_allclose(multiply(a, b[0]), multiply(a, np.tile(b[0], (30, 1))), atol=1e-15)
    np.testing.assert_allclose(rotation_matrix(multiply(a, b)), rotation_matrix(a) @ rotation_matrix(b), atol=1e-14)


def test_rotation_matrices() -> None:
    a = quaternions(30, 5)
    np.testing.assert_allclose(rotations(a), rotation_matrix(a), atol=1e-15)
    for each, matrix in zip(a, rotations(a), strict=True):
        np.testing.assert_allclose(quaternion_of(matrix), each if each[3] > 0 else -each, atol=1e-12)


def test_turns_about_the_vertical() -> None:
    a, yaw = quaternions(30, 5), np.linspace(-9, 9, 30)
    turned = Rotation.from_euler("z", yaw[:, None]) * Rotation.from_quat(a)
    np.testing.assert_allclose(rotations(turn_z(yaw, a)), turned.as_matrix(), atol=1e-14)


def test_slerp() -> None:
    a, b, share = quaternions(30, 5), quaternions(30, 6), np.random.default_rng(7).random(30)
    expected = [Slerp([0, 1], Rotation.from_quat([a[k], b[k]]))(share[k]).as_matrix() for k in range(30)]
    np.testing.assert_allclose(rotation_matrix(slerp(a, b, share[:, None])), expected, atol=1e-12)
    np.testing.assert_allclose(
        slerp(a, -a, share[:, None]) * np.sign(slerp(a, -a, share[:, None])[:, 3:] * a[:, 3:]), a
    )
