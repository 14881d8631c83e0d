"""What was heard lately? The last ticks' odometry and detection sets, and how a pose is carried from tick to tick.

Bodies are numbered from the station's point of view here: index 0 is the station itself, then the other MAVs in
ascending order.
"""

from dataclasses import dataclass

import numpy as np

from agent.interface.frames import Array, rotate_z, wrap


@dataclass
class Frame:
    """One tick: everybody's odometry and detection sets, NaN where nothing was heard."""

    tick: int
    odometry: Array  # (N, 4) x y z m, yaw rad in each MAV's odometry frame; unheard ones go on as they last did
    read: np.ndarray[tuple[int], np.dtype[np.bool_]]  # (N,) whose odometry was heard
    spherical: Array  # (N, M, 3) range m, azimuth rad, elevation rad of every station's detections, NaN beyond its last
    heard: np.ndarray[tuple[int], np.dtype[np.bool_]]  # (N,) whose detection set was heard

    def put(self, station: int, spherical: Array) -> None:
        """Adds the detection set (M, 3) of this station (index)."""
        missing = len(spherical) - self.spherical.shape[1]
        if missing > 0:
            self.spherical = np.pad(self.spherical, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)
        self.spherical[station, : len(spherical)] = spherical
        self.heard[station] = True


class Window:
    """The last `length` frames, oldest first."""

    def __init__(self, mavs: int, length: int) -> None:
        self._mavs, self._length = mavs, length
        self.frames: list[Frame] = []

    def add(self, tick: int, odometry: dict[int, Array]) -> Frame:
        """Begins a tick from the odometry readings (4,) that were heard, by index; the station's own is among them."""
        readings = np.full((self._mavs, 4), np.nan)
        for index, reading in odometry.items():
            readings[index] = reading
        read = np.isfinite(readings[:, 3])
        if self.frames:
            before = self.frames[-1].odometry
            coasted = before + (before - self.frames[-2].odometry if len(self.frames) > 1 else 0.0)
            readings[~read] = coasted[~read]
        readings[np.isnan(readings)] = 0.0  # never heard: of no meaning, as it is neither station nor placed
        frame = Frame(tick, readings, read, np.full((self._mavs, 0, 3), np.nan), np.zeros(self._mavs, bool))
        self.frames.append(frame)
        del self.frames[: -self._length]
        return frame

    def at(self, tick: int) -> Frame | None:
        """The frame of this tick, while it is kept."""
        index = tick - self.frames[0].tick if self.frames else -1
        return self.frames[index] if 0 <= index < len(self.frames) else None


def carried(poses: Array, odometry_there: Array, odometry_here: Array) -> Array:
    """Poses (..., 4) in one frame, moved as the odometry (..., 4) says from where it read `there` to `here`."""
    turn = poses[..., 3] - odometry_there[..., 3]
    moved = np.empty(np.broadcast_shapes(poses.shape, odometry_here.shape))
    moved[..., :3] = poses[..., :3] + rotate_z(turn, odometry_here[..., :3] - odometry_there[..., :3])
    moved[..., 3] = poses[..., 3] + wrap(odometry_here[..., 3] - odometry_there[..., 3])
    return moved
