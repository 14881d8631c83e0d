"""What does a VIO reading say, once gravity is taken out?"""

from typing import NamedTuple

import numpy as np

from agent.interface import messages
from agent.interface.frames import Array, rotate_z, rotation_matrix, yaw_of


class Levelled(NamedTuple):
    pose: Array  # (4,) x y z m, yaw rad of the body in its odometry frame
    tilt: Array  # (3, 3) R_level_body: from the rolled and pitched body to the gravity-aligned one


def read(message: messages.Vio) -> Levelled:
    """Roll and pitch are observable to VIO and so known; only yaw and position drift (the paper, Sec. IV-A)."""
    quaternion = messages.floats(message.quaternion)
    yaw = yaw_of(quaternion)
    tilt = rotate_z(-yaw, rotation_matrix(quaternion).T).T
    return Levelled(np.append(messages.floats(message.position), yaw), tilt)
