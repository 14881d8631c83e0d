"""Is who is not heard any more still to be seen?

A MAV that has landed, flown out of range or behind a wall is detected by nobody, and then it is false detections that
lie in its ever larger gate. A detection probability that is always the same makes one of them its own sooner or later.

So whoever is silent for longer than guesses of its motion are good has a probability r of being in view, by which its
P_D is multiplied: integrated probabilistic data association (Musicki, Evans and Stankovic, 1994). A tick's sets change
it, set by set, by

    r / (1 - r)  <-  Lambda r / (1 - r),   Lambda = 1 - P_D + P_D sum_m N(z_m; z_hat, S) / rho_m

where rho_m is the density of what else the detection may be: false, or one of the other MAVs, each as if it were
clutter of its own density (linear multitarget IPDA: Musicki and La Scala, 2008).
"""

import numpy as np
import numpy.typing as npt

from agent.estimator.innovations import Innovations
from agent.estimator.station_update import Pairs
from agent.interface.frames import Array

SWITCHES_PER_S = 1e-3  # how often a MAV goes out of view, or comes back


def later(in_view: Array, silent: npt.NDArray[np.bool_], time_s: float) -> Array:
    """The probabilities (N,) after this time; 1 for all that are not silent (N,)."""
    if not silent.any():
        return np.ones(len(in_view))
    switched = in_view + SWITCHES_PER_S * time_s * (1 - 2 * in_view)
    return np.where(silent, np.clip(switched, 0.0, 1.0), 1.0)


def looked_for(in_view: Array, pairs: Pairs, stations: list[int], found: Innovations | None, clutter: float) -> Array:
    """The probabilities (B,) of all bodies given a tick's detection sets.

    Args:
        in_view: (B,) before.
        pairs: of this tick, P_D of who is in view.
        stations: K, the bodies whose sets there are.
        found: in these sets; None if they are all empty.
        clutter: false detections per m^3.
    """
    P_D = pairs.P_D[stations]
    ratio = 1 - P_D
    if found is not None:
        distance = found.distance[stations]
        density = np.exp(-0.5 * np.where(np.isnan(distance), np.inf, distance))
        density /= np.sqrt((2 * np.pi) ** 3 * found.determinant[stations])[:, :, None]
        expected = (P_D * in_view)[:, :, None] * density
        rho = np.maximum(clutter + expected.sum(1, keepdims=True) - expected, clutter)
        ratio += P_D * (density / rho).sum(2)
    odds = ratio.prod(0) * in_view
    found_again: Array = odds / (odds + 1 - in_view)
    return np.where(in_view < 1, found_again, 1.0)
