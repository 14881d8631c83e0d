"""Where is everybody in a formation, seen from its centre and with its heading along x? For paths and for missions."""

import math
from typing import Literal, Protocol

import numpy as np

from agent.interface.frames import Array
from agent.interface.tables import BadExperiment

Formation = Literal["circle", "line", "v", "grid", "points"]
SIZES = {"circle": "radius_m", "line": "length_m", "v": "length_m", "grid": "spacing_m", "points": "points"}


class HasFormation(Protocol):
    """A leg of a path or of a mission."""

    @property
    def formation(self) -> str: ...


def size_key(leg: HasFormation, sizes: dict[str, str], where: str) -> str:
    """Which key says how large the leg's formation is.

    Raises:
        BadExperiment: it is not given, or another is.
    """
    needed = sizes[leg.formation]
    for name in dict.fromkeys(sizes.values()):
        given = getattr(leg, name) is not None
        if given != (name == needed):
            verb = "does not take" if given else "needs"
            raise BadExperiment(f"{where}: formation {leg.formation!r} {verb} {name}")
    return needed


def regular(formation: str, size_m: float, mavs: int) -> Array:
    """(N, 3) m: x ahead, y left, all at one height; left to right (y falls), then front to back."""
    places = np.zeros((mavs, 3))
    places[:, :2] = _shape(formation, size_m, mavs)
    # Rounded, because sines of equal places differ in the last bit.
    return places[np.lexsort((-places[:, 0].round(6), -places[:, 1].round(6)))]


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
