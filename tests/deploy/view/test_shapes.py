"""Is the ellipsoid that is drawn the covariance that was believed?"""

import numpy as np
from scipy.spatial.transform import Rotation

from deploy.view.shapes import SIGMAS, ellipsoids, quaternions


def test_the_axes_make_the_covariance_again() -> None:
    A = np.random.default_rng(0).normal(size=(4, 5, 3, 3))
    P = A @ A.swapaxes(-1, -2)
    half, turns = ellipsoids(P)
    R = Rotation.from_quat(turns.reshape(-1, 4)).as_matrix().reshape(4, 5, 3, 3)
    made = R @ ((half / SIGMAS)[..., None] ** 2 * R.swapaxes(-1, -2))
    np.testing.assert_allclose(made, P, atol=1e-12)


def test_quaternions_are_those_of_scipy_half_turns_included() -> None:
    turns = Rotation.random(200, rng=np.random.default_rng(1)).as_matrix()
    half = np.array([np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1]), np.eye(3)])
    for R in (turns, half):
        back = Rotation.from_quat(quaternions(R)).as_matrix()
        np.testing.assert_allclose(back, R, atol=1e-12)


def test_nothing_is_nothing() -> None:
    half, turns = ellipsoids(np.zeros((0, 3, 3)))
    assert half.shape == (0, 3)
    assert turns.shape == (0, 4)
