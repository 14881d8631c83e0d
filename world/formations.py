"""Where is everybody in a formation, seen from its centre and with its heading along x?"""

import math

import numpy as np

from agent.interface.frames import Array
from world.clearance import are_apart, drawn_until

BOX_CLEARANCE_M = 1.0  # least distance of two MAVs in a box


def regular(formation: str, size_m: float, mavs: int) -> Array:
    """(N, 3) m: x ahead, y left, all at one height; left to right (y falls), then front to back."""
    places = np.zeros((mavs, 3))
    places[:, :2] = _shape(formation, size_m, mavs)
    # Rounded, because sines of equal places differ in the last bit.
    return places[np.lexsort((-places[:, 0].round(6), -places[:, 1].round(6)))]


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


def _shape(formation: str, size_m: float, mavs: int) -> Array:
    """(N, 2) m: x ahead, y left, about the centre."""
    k = np.arange(mavs)
    if formation == "circle":
        angle = 2 * np.pi * k / mavs
        return np.asarray(size_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    if formation == "line":
        sideways = size_m * ((mavs - 1) / 2 - k) / max(mavs - 1, 1)
        return np.asarray(np.stack([np.zeros(mavs), sideways], axis=-1))
    if formation == "v":
        rank, side = (k + 1) // 2, np.where(k % 2, 1.0, -1.0)  # the tip, then left and right in turn
        along = size_m / math.sqrt(2) * rank / max(mavs // 2, 1)
        return np.asarray(np.stack([along.max() / 2 - along, side * along], axis=-1))
    columns = math.ceil(math.sqrt(mavs))
    places = size_m * np.stack([-(k // columns), -(k % columns)], axis=-1).astype(float)
    return np.asarray(places - (places.max(axis=0) + places.min(axis=0)) / 2)
