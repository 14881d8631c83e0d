"""Where are the MAVs, and what does their odometry read, when recorded flights are played instead of simulated ones?"""

from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from agent.interface.fleet import Fleet
from agent.interface.frames import Array, compose, inverse, rotation_matrix
from agent.interface.tables import BadExperiment
from world.poses import Poses, multiply, quaternion_of, slerp

MAX_GAP_S = 0.5  # between two rows; nothing is made up across a longer one
FARTHEST_M = 1e6  # no message says more


class Flight(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One MAV's recorded flight: two TUM files (t x y z qx qy qz qw; white space or commas; # comments) that keep one
    time, the truths of all flights in one gravity-aligned frame."""

    truth: str  # file in flights_dir
    vio: str  # file in flights_dir; its frame is gravity-aligned too
    from_s: float = 0.0  # tick 0 is the first VIO row at or after this time since both files have begun


class Track(NamedTuple):
    """One file: K rows."""

    path: Path
    time_s: Array  # (K,) rising
    poses: Poses


class RecordedFlights:
    """A source of motion: `true` and `vio` are the poses of this tick, `step` goes on to the next."""

    def __init__(self, flights: tuple[Flight, ...], flights_dir: str | None, fleet: Fleet) -> None:
        """
        Raises:
            BadExperiment: not one flight per MAV, or files that are missing, malformed or too short.
        """
        if len(flights) != fleet.mavs:
            raise BadExperiment(f"world.flights: {len(flights)} flights, expected {fleet.mavs}, one per MAV")
        if flights_dir is None:
            raise BadExperiment(
                "world.flights_dir: where are the recorded flights? give it with --set world.flights_dir=DIR"
            )
        ticks_s = np.array([fleet.stamp_ns(tick) for tick in range(fleet.ticks)]) / 1e9
        played = [_play(flight, Path(flights_dir), f"world.flights[{k}]", ticks_s) for k, flight in enumerate(flights)]
        self._true = _together([true for true, _ in played])
        self._vio = _together([vio for _, vio in played])
        self._tick = 0
        self.pose_world_odom = compose(self.true.level, inverse(self.vio.level))  # (N, 4), as true as at tick 0

    @property
    def true(self) -> Poses:
        return Poses(self._true.position[self._tick], self._true.quaternion[self._tick])

    @property
    def vio(self) -> Poses:
        """In each MAV's odometry frame."""
        return Poses(self._vio.position[self._tick], self._vio.quaternion[self._tick])

    def step(self) -> None:
        self._tick += 1


def read_track(path: Path, where: str) -> Track:
    """
    Raises:
        BadExperiment: no such file, or a line of it that is no pose.
    """
    rows: list[list[float]] = []
    numbers: list[int] = []
    try:
        with path.open() as file:
            for number, line in enumerate(file, 1):
                text = line.partition("#")[0].replace(",", " ").split()
                if text:
                    rows.append(_row(text, f"{where}: {path}, line {number}"))
                    numbers.append(number)
    except OSError as error:
        raise BadExperiment(f"{where}: cannot read {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise BadExperiment(f"{where}: {path} is not a text file") from None
    table = np.array(rows).reshape(-1, 8)
    length = np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
    for wrong, what in (
        (~np.isfinite(table).all(axis=1), "not finite"),
        ((np.abs(table[:, 1:4]) >= FARTHEST_M).any(axis=1), f"a position beyond {FARTHEST_M:g} m"),
        (np.abs(length[:, 0] - 1) > 0.01, "a quaternion whose length is not 1"),
        (np.diff(table[:, 0], prepend=-np.inf) <= 0, "a time that does not come after the row before"),
    ):
        if wrong.any():
            raise BadExperiment(f"{where}: {path}, line {numbers[int(wrong.argmax())]}: {what}")
    return Track(path, table[:, 0], Poses(table[:, 1:4], table[:, 4:] / length))


def body_rotation(truth: Track) -> Array:
    """(4,) quaternion of a MAV's body in the body that was recorded.

    The recorded body may be an IMU mounted in any way (EuRoC's has x up, which makes yaw singular). Our z axis is where
    up is in it on average over the file; our x axis is the first of its x, z and y that is not within 45 deg of that,
    made level. A body that is z up and hovers level is left as it is; EuRoC's gets its cameras' way of looking as x.
    """
    up = rotation_matrix(truth.poses.quaternion)[:, 2].mean(axis=0)
    up /= np.linalg.norm(up)
    ahead = next(axis for axis in np.eye(3)[[0, 2, 1]] if abs(axis @ up) < np.sqrt(0.5) + 1e-9)
    x = ahead - (ahead @ up) * up
    x /= np.linalg.norm(x)
    return quaternion_of(np.stack([x, np.cross(up, x), up], axis=-1))


def _row(text: list[str], where: str) -> list[float]:
    if len(text) != 8:
        raise BadExperiment(f"{where}: {len(text)} columns, expected 8: t x y z qx qy qz qw")
    try:
        return [float(number) for number in text]
    except ValueError as error:
        raise BadExperiment(f"{where}: {error}") from None


def _play(flight: Flight, folder: Path, where: str, ticks_s: Array) -> tuple[Poses, Poses]:
    """True and VIO poses at the ticks."""
    truth = read_track(folder / flight.truth, where)
    vio = _without_placeholders(read_track(folder / flight.vio, where))
    if not (len(truth.time_s) and len(vio.time_s)):
        raise BadExperiment(f"{where}: {flight.truth} or {flight.vio} holds no poses")
    begin = max(truth.time_s[0], vio.time_s[0]) + flight.from_s
    end = min(truth.time_s[-1], vio.time_s[-1])
    later = vio.time_s[vio.time_s >= begin]
    at = (later[0] if len(later) else begin) + ticks_s
    if flight.from_s < 0 or at[-1] > end + 1e-6:
        raise BadExperiment(
            f"{where}: {ticks_s[-1]:g} s from from_s = {flight.from_s:g} on are asked for, but {flight.truth} and "
            f"{flight.vio} have {max(end - begin + flight.from_s, 0):.1f} s in common"
        )
    turn = body_rotation(truth)
    true, read = (_at(track, at, where) for track in (truth, vio))
    return Poses(true.position, multiply(true.quaternion, turn)), Poses(read.position, multiply(read.quaternion, turn))


def _without_placeholders(vio: Track) -> Track:
    """Without the rows at the start that say exactly "at zero, not turned": a VIO that has not begun yet."""
    waiting = (vio.poses.position == 0).all(axis=1) & (vio.poses.quaternion == (0, 0, 0, 1)).all(axis=1)
    first = len(waiting) if waiting.all() else int(waiting.argmin())
    return Track(vio.path, vio.time_s[first:], Poses(vio.poses.position[first:], vio.poses.quaternion[first:]))


def _at(track: Track, at_s: Array, where: str) -> Poses:
    """Between rows: positions linearly, rotations along the shortest turn."""
    time_s, poses = track.time_s, track.poses
    after = np.clip(np.searchsorted(time_s, at_s), 1, len(time_s) - 1) if len(time_s) > 1 else np.zeros(len(at_s), int)
    before = np.maximum(after - 1, 0)
    gap = time_s[after] - time_s[before]
    if gap.max() > MAX_GAP_S:
        raise BadExperiment(
            f"{where}: {track.path} has a gap of {gap.max():.2f} s at {time_s[before[gap.argmax()]]:.3f} s, at most "
            f"{MAX_GAP_S:g} s are bridged"
        )
    share = np.clip((at_s - time_s[before]) / np.where(gap > 0, gap, 1), 0, 1)[:, None]
    position = (1 - share) * poses.position[before] + share * poses.position[after]
    return Poses(position, slerp(poses.quaternion[before], poses.quaternion[after], share))


def _together(poses: list[Poses]) -> Poses:
    """(T, N, ...) from N times (T, ...)."""
    position = np.stack([each.position for each in poses], axis=1)
    return Poses(position, np.stack([each.quaternion for each in poses], axis=1))
