"""A team without processes or physics: true paths, drifting odometry and anonymous detection sets, for tests."""

from typing import NamedTuple

import numpy as np

from agent.interface.frames import compose, range_and_bearing, relative_pose, rotate_z
from agent.interface.sensors import Detector, Odometry


class Tick(NamedTuple):
    truth: np.ndarray  # (N, 4) x y z yaw in the world
    odometry: dict[int, np.ndarray]
    sets: dict[int, np.ndarray]  # by MAV: (M, 3) spherical
    labels: dict[int, np.ndarray]  # by MAV: (M,) MAV number, 0 for false


def frames_in(truth, station):
    """(N, 4) every MAV's pose in MAV `station`'s: at the start, where its odometry frame is."""
    return relative_pose(np.tile(truth[station - 1], (len(truth), 1)), truth)


def circling(rng, mavs, ticks, far_m=0.0, **sensors):
    """Yields ticks of a circle that breathes between 1.35 and 2.7 m, while it travels `far_m` in the first 5 s."""
    angle = 2 * np.pi * np.arange(mavs) / mavs
    scale = max(1, mavs / 7)

    def places(t):
        radius = scale * (1.35 + 0.675 * (1 - np.cos(2 * np.pi * t / 24)))
        centre = far_m * min(1.0, t / 5)
        return np.column_stack([centre + radius * np.cos(angle), radius * np.sin(angle), np.full(mavs, 1.5)])

    return fly(rng, mavs, ticks, places, **sensors)


def in_line(rng, mavs, ticks, **sensors):
    """Yields ticks of a line that breathes between 6 and 12 m: targets stand behind one another."""
    along = np.arange(mavs) / (mavs - 1) - 0.5
    scale = max(1, mavs / 7)

    def places(t):
        length = scale * (6 + 3 * (1 - np.cos(2 * np.pi * t / 24)))
        return np.column_stack([length * along, np.zeros(mavs), np.full(mavs, 1.5)])

    return fly(rng, mavs, ticks, places, **sensors)


PATHS = {"circle": circling, "line": in_line}


def fly(rng, mavs, ticks, places, detector=None, odometry=None, rate_hz=10.0):
    """Yields ticks of MAVs that are at `places(t)` (N, 3), with constant random yaws."""
    detector, odometry = detector or Detector(), odometry or Odometry()
    yaw = rng.uniform(-np.pi, np.pi, mavs)
    readings = np.zeros((mavs, 4))
    before = None
    for k in range(ticks):
        truth = np.column_stack([places(k / rate_hz), yaw])
        if before is not None:
            noise = np.column_stack(
                [rng.normal(0, odometry.position_sigma_m, (mavs, 3)), rng.normal(0, odometry.yaw_sigma_rad, mavs)]
            )
            readings = compose(readings, relative_pose(before, truth) + noise)
        before = truth
        seen = [detect(rng, truth, i, detector) for i in range(mavs)]
        yield Tick(
            truth,
            {i + 1: readings[i] for i in range(mavs)},
            {i + 1: spherical for i, (spherical, _) in enumerate(seen)},
            {i + 1: labels for i, (_, labels) in enumerate(seen)},
        )


def detect(rng, truth, i, detector):
    lines = rotate_z(-truth[i, 3], truth[:, :3] - truth[i, :3])
    seen = [j for j in range(len(truth)) if j != i and rng.random() < detector.P_D]
    seen = [j for j in seen if np.linalg.norm(lines[j]) < detector.max_range_m]
    spherical = range_and_bearing(lines[seen])
    n = len(seen)
    spherical[:, 0] += rng.normal(0, 1, n) * detector.range_sigma_m(spherical[:, 0])
    spherical[:, 1] += rng.normal(0, detector.bearing_sigma_rad, n) / np.cos(spherical[:, 2])
    spherical[:, 2] += rng.normal(0, detector.bearing_sigma_rad, n)
    false = rng.poisson(detector.false_per_set)
    clutter = np.column_stack(
        [
            detector.max_range_m * rng.random(false) ** (1 / 3),
            rng.uniform(-np.pi, np.pi, false),
            np.arcsin(rng.uniform(-1, 1, false)),
        ]
    )
    order = rng.permutation(n + false)
    labels = np.array([*(j + 1 for j in seen), *[0] * false], dtype=int)
    return np.concatenate([spherical, clutter])[order], labels[order]
