"""What is the pose of a MAV that also rolls and pitches? Positions and quaternions, and turns of them."""

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
        return np.column_stack([self.position, yaw_of(self.quaternion)])


def multiply(a: Array, b: Array) -> Array:
    """Quaternions x y z w (..., 4) of the rotation b followed by a."""
    ax, ay, az, aw = (a[..., k] for k in range(4))
    bx, by, bz, bw = (b[..., k] for k in range(4))
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )


def turn_z(yaw: Array, quaternion: Array) -> Array:
    """Quaternions (N, 4) turned about the vertical by yaw (N,) rad."""
    zero = np.zeros_like(yaw)
    return multiply(np.stack([zero, zero, np.sin(yaw / 2), np.cos(yaw / 2)], axis=-1), quaternion)


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
