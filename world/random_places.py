"""Where is everybody who starts at random?"""

import numpy as np

from agent.interface.frames import Array
from world.clearance import are_apart, drawn_until

BOX_CLEARANCE_M = 1.0  # least distance of two MAVs in a box


def box(
    size_m: tuple[float, float, float], mavs: int, random: np.random.Generator, where: str, flat: bool = False
) -> Array:
    """(N, 3) m: x ahead, y left, z up, uniform in the box as far as BOX_CLEARANCE_M allows; in no order.

    Args:
        flat: all at its middle height.

    Raises:
        BadExperiment: the box is too full for that.
    """
    half = np.array(size_m) / 2
    half[2] *= not flat
    return drawn_until(
        lambda places: are_apart(places, BOX_CLEARANCE_M),
        lambda: random.uniform(-half, half, (mavs, 3)),
        f"{where}.size_m = {list(size_m)}: {mavs} MAVs are never all {BOX_CLEARANCE_M:g} m apart in it, expected a "
        f"larger box",
    )
