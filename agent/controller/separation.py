"""What keeps a MAV off another that is not where it should be? A push away, the stronger the nearer."""

import numpy as np

from agent.interface.frames import Array

KEEP_M = 0.75  # of two centres, beside what is not known: MAVs are 0.54 m across
SIGMAS = 2.0
MOST_M = 0.4  # by which a setpoint is displaced


def push(position: Array, others: Array, sigmas: Array) -> Array:
    """By how much (3,) m to displace the setpoint of a MAV.

    Args:
        position: (3,) m: where it is.
        others: (n, 3) m: where it believes the others.
        sigmas: (n,) m: how well it knows.
    """
    away = position - others
    distance = np.maximum(np.linalg.norm(away, axis=-1), 1e-6)
    excess = np.maximum(KEEP_M + SIGMAS * sigmas - distance, 0.0)
    total = (away / distance[:, None] * excess[:, None]).sum(0)
    length = float(np.linalg.norm(total))
    return np.asarray(total * min(1.0, MOST_M / length) if length > 0 else total)
