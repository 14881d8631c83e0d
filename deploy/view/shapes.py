"""Which ellipsoid is a covariance?"""

import numpy as np

from agent.interface.frames import Array

SIGMAS = 3.0


def ellipsoids(covariances: Array) -> tuple[Array, Array]:
    """Half axes (..., 3) of three standard deviations, m, and their quaternions x y z w (..., 4).

    Args:
        covariances: (..., 3, 3) m^2.
    """
    values, vectors = np.linalg.eigh(covariances)
    vectors[..., 0] *= np.sign(np.linalg.det(vectors))[..., None]  # a rotation, no mirror
    return SIGMAS * np.sqrt(np.maximum(values, 0)), quaternions(vectors)


def quaternions(R: Array) -> Array:
    """(..., 4) x y z w of rotation matrices (..., 3, 3): the eigenvector that Bar-Itzhack gives (JGCD 23(6), 2000).

    scipy has it, too, but takes a second to import.
    """
    K = np.empty((*R.shape[:-2], 4, 4))
    K[..., :3, :3] = R + R.swapaxes(-1, -2)
    trace = np.trace(R, axis1=-2, axis2=-1)[..., None]
    K[..., range(3), range(3)] -= trace
    skew = [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]]
    K[..., 3, :3] = K[..., :3, 3] = np.stack(skew, axis=-1)
    K[..., 3, 3] = trace[..., 0]
    return np.asarray(np.linalg.eigh(K)[1][..., -1])
