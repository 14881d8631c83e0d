"""What is the pose of a MAV that also rolls and pitches? Positions and quaternions, and turns of them.

Products of quaternions and entries of rotation matrices are sums of products of two quaternion entries, so one matrix
product with a constant gives them all: for few MAVs, what costs is the number of calls.
"""

from typing import NamedTuple

import numpy as np

from agent.interface.frames import Array, yaw_of


class Poses(NamedTuple):
    """Of N MAVs in one gravity-aligned frame."""

    position: Array  # (N, 3) m
    quaternion: Array  # (N, 4) x y z w

    @property
    def level(self) -> Array:
        """(N, 4) x y z m, yaw rad: roll and pitch taken out."""
        level = np.empty(self.quaternion.shape)
        level[:, :3], level[:, 3] = self.position, yaw_of(self.quaternion)
        return level


def multiply(a: Array, b: Array) -> Array:
    """Quaternions x y z w (..., 4) of the rotation b followed by a."""
    return np.asarray(_products(a, b) @ _MULTIPLY)


def rotations(quaternion: Array) -> Array:
    """Rotation matrices (N, 3, 3) of unit quaternions x y z w (N, 4)."""
    return np.asarray((_products(quaternion, quaternion) @ _ROTATE).reshape(-1, 3, 3))


def turn_z(yaw: Array, quaternion: Array) -> Array:
    """Quaternions (N, 4) turned about the vertical by yaw (N,) rad."""
    turn = np.zeros((len(yaw), 4))
    turn[:, 2], turn[:, 3] = np.sin(yaw / 2), np.cos(yaw / 2)
    return multiply(turn, quaternion)


def slerp(start: Array, goal: Array, share: Array) -> Array:
    """Quaternions (K, 4) at this share (K, 1) of the shortest turn from start (K, 4) to goal (K, 4)."""
    cosine = (start * goal).sum(axis=-1, keepdims=True)
    goal, angle = np.where(cosine < 0, -goal, goal), np.arccos(np.minimum(np.abs(cosine), 1.0))
    small = angle < 1e-6
    sine = np.where(small, 1.0, np.sin(angle))
    a = np.where(small, 1 - share, np.sin((1 - share) * angle) / sine)
    b = np.where(small, share, np.sin(share * angle) / sine)
    turned = a * start + b * goal
    return np.asarray(turned / np.linalg.norm(turned, axis=-1, keepdims=True))


def quaternion_of(matrix: Array) -> Array:
    """Quaternion (4,) x y z w, w not negative, of a rotation matrix (3, 3): the eigenvector of Bar-Itzhack (2000)."""
    (a, b, c), (d, e, f), (g, h, i) = matrix
    k = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    quaternion = np.linalg.eigh(k).eigenvectors[:, -1]
    return np.asarray(quaternion if quaternion[3] >= 0 else -quaternion)


def _products(a: Array, b: Array) -> Array:
    """(..., 16) a_x b_x, a_x b_y, ... a_w b_w."""
    pairs = a[..., :, None] * b[..., None, :]
    return np.asarray(pairs.reshape(*pairs.shape[:-2], 16))


# Hamilton's products: the first unit (block i, j, k or 1) times the second (column) gives the third (row).
_HAMILTON = [
    [[0, 0, 0, 1], [0, 0, -1, 0], [0, 1, 0, 0], [-1, 0, 0, 0]],
    [[0, 0, 1, 0], [0, 0, 0, 1], [-1, 0, 0, 0], [0, -1, 0, 0]],
    [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
    [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
]
UNIT_PRODUCTS = np.array(_HAMILTON, float).transpose(0, 2, 1)  # (4, 4, 4): [a, b] is the product of the units a and b
CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
_MULTIPLY = UNIT_PRODUCTS.reshape(16, 4)
# q v q* is a sum over the entries a and b of q; for v the axis j, its entry i is R[i, j].
_TURNED_AXES = np.einsum("ajm,mbi,b->abij", UNIT_PRODUCTS[:, :3], UNIT_PRODUCTS[..., :3], CONJUGATE)
_ROTATE = _TURNED_AXES.reshape(16, 9)
