"""What does a VIO reading say, once gravity is taken out?"""

import math
from typing import NamedTuple

import numpy as np

from agent.interface import messages
from agent.interface.frames import Array, rotation_matrix, yaw_of


class Levelled(NamedTuple):
    pose: Array  # (4,) x y z m, yaw rad of the body in its odometry frame
    tilt: Array  # (3, 3) R_level_body: from the rolled and pitched body to the gravity-aligned one


def read(message: messages.Vio) -> Levelled:
    """Roll and pitch are observable to VIO and so known; only yaw and position drift (the paper, Sec. IV-A)."""
    quaternion, pose = messages.floats(message.quaternion), np.empty(4)
    pose[:3], pose[3] = messages.floats(message.position), yaw_of(quaternion)
    c, s = math.cos(pose[3]), math.sin(pose[3])
    level = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return Levelled(pose, level @ rotation_matrix(quaternion))
