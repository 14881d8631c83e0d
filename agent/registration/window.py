"""What was heard lately? The last ticks' odometry and detection sets, and how a pose is carried from tick to tick.

What is late is put into its tick as long as nobody has made use of that: `settle` says that somebody does.

Bodies are numbered from the station's point of view here: index 0 is the station itself, then the other MAVs in
ascending order.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array, rotate_z, wrap

Mask = npt.NDArray[np.bool_]


@dataclass
class Frame:
    """One tick: everybody's odometry and detection sets, NaN where nothing was heard."""

    tick: int
    odometry: Array  # (N, 4) x y z m, yaw rad in each MAV's odometry frame; unheard ones go on as they last did
    read: Mask  # (N,) whose odometry was heard, or is known from readings before and after
    spherical: Array  # (N, M, 3) range m, azimuth rad, elevation rad of every station's detections, NaN beyond its last
    heard: Mask  # (N,) whose detection set was heard

    def put(self, station: int, spherical: Array) -> None:
        """Adds the detection set (M, 3) of this station (index)."""
        missing = len(spherical) - self.spherical.shape[1]
        if missing > 0:
            self.spherical = np.pad(self.spherical, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)
        self.spherical[station, : len(spherical)] = spherical
        self.heard[station] = True

    def put_odometry(self, mav: int, reading: Array) -> None:
        """Adds the odometry reading (4,) of this MAV (index)."""
        self.odometry[mav], self.read[mav] = reading, True


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
        frame = Frame(tick, readings, read, np.full((self._mavs, 0, 3), np.nan), np.zeros(self._mavs, bool))
        self.frames.append(frame)
        del self.frames[: -self._length]
        if not read.all():
            self.settle(frame)
        return frame

    def settle(self, frame: Frame) -> None:
        """Makes up for the readings that a frame lacks: between two others, or on as that MAV last went."""
        index = frame.tick - self.frames[0].tick
        before, later = self.frames[:index], self.frames[index + 1 :]
        for j in np.flatnonzero(frame.read & ~before[-1].read) if before else ():
            self._bridge(before, frame, int(j))
        for j in np.flatnonzero(~frame.read):
            nearest = next((other for other in later if other.read[j]), None)
            if before and before[-1].read[j] and nearest is not None:
                last = before[-1].odometry[j]
                chord = nearest.odometry[j] - last
                chord[3] = wrap(chord[3])
                frame.odometry[j] = last + chord / (nearest.tick - before[-1].tick)
                frame.read[j] = True
            elif before:
                last = before[-1].odometry[j]
                frame.odometry[j] = last + (last - before[-2].odometry[j] if len(before) > 1 else 0.0)
            else:
                frame.odometry[j] = 0.0  # never heard: of no meaning, as it is neither station nor placed

    def _bridge(self, before: list[Frame], frame: Frame, j: int) -> None:
        """Makes the silence that a reading ends a chord: where it went on as it last did, hypotheses that have followed
        what is seen of that MAV would be moved a second time by the reading that makes up for it."""
        silence = next((k for k, other in enumerate(reversed(before)) if other.read[j]), None)
        if silence is None:
            return
        last = before[-1 - silence].odometry[j]
        chord = frame.odometry[j] - last
        chord[3] = wrap(chord[3])
        for k, other in enumerate(before[len(before) - silence :], start=1):
            other.odometry[j] = last + chord * (k / (silence + 1))
            other.read[j] = True

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
