"""What does a pilot know of those around it?"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array
from agent.interface.intent import Intent


class Surroundings(NamedTuple):
    """At one tick; MAVs by index, poses x y z m, yaw rad in the own odometry frame."""

    stamp_ns: int
    odometry: Array  # (4,) its own
    poses: Array  # (N, 4) of all
    sigmas: Array  # (N,) m: of their positions
    frames: Array  # (N, 4) of all odometry frames; NaN where not known
    localised: npt.NDArray[np.bool_]  # (N,) who is: position and yaw
    placed: npt.NDArray[np.bool_]  # (N,) whose position is known as well, whatever is known of its yaw
    present: npt.NDArray[np.bool_]  # (N,) who is not gone
    intents: dict[int, Intent]  # by MAV: what the others last said they are about to do
