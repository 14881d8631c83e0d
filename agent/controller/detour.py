"""How does a way lead past a MAV that hangs in the air without its agent? Around it, at its height."""

import numpy as np

from agent.interface.frames import Array

CLEAR_M = 0.92  # from the waypoint beside it, so that the way from a place as near as that keeps 0.65 m
LEVEL = 1e-6


def waypoints(begin: Array, goal: Array, obstacles: Array) -> Array:
    """(W, 3) m from (3,) begin to (3,) goal, with one beside each of the obstacles (n, 3) that the straight way passes
    nearer than CLEAR_M; m, in one frame."""
    way = goal - begin
    length = float(np.linalg.norm(way))
    beside = []
    for obstacle in obstacles:
        share = float(np.clip((obstacle - begin) @ way / max(length, LEVEL) ** 2, 0.0, 1.0))
        off = begin + share * way - obstacle
        if 0 < share < 1 and np.linalg.norm(off) < CLEAR_M:
            aside = np.array([-way[1], way[0], 0.0])  # to the left, level, or up, where the way is
            width = float(np.linalg.norm(aside))
            aside = aside / width if width > LEVEL * length else np.array([1.0, 0.0, 0.0])
            beside.append((share, obstacle + CLEAR_M * (aside if off @ aside >= 0 else -aside)))
    return np.stack([begin, *(point for _, point in sorted(beside, key=lambda each: each[0])), goal])
