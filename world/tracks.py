"""Which poses are in a recorded file, and where between them is the MAV?"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from agent.interface.frames import Array
from agent.interface.tables import BadExperiment
from world.poses import Poses, slerp

MAX_GAP_S = 0.5  # between two rows; nothing is made up across a longer one
FARTHEST_M = 1e6  # no message says more


class Track(NamedTuple):
    """One file: K rows."""

    path: Path
    time_s: Array  # (K,) rising
    poses: Poses


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
    except ValueError as error:  # as of a NUL in its name
        raise BadExperiment(f"{where}: cannot read {str(path)!r}: {error}") from None
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


def without_placeholders(vio: Track) -> Track:
    """Without the rows at the start that say exactly "at zero, not turned": a VIO that has not begun yet."""
    waiting = (vio.poses.position == 0).all(axis=1) & (vio.poses.quaternion == (0, 0, 0, 1)).all(axis=1)
    first = len(waiting) if waiting.all() else int(waiting.argmin())
    return Track(vio.path, vio.time_s[first:], Poses(vio.poses.position[first:], vio.poses.quaternion[first:]))


def poses_at(track: Track, at_s: Array, where: str) -> Poses:
    """Between rows: positions linearly, rotations along the shortest turn.

    Raises:
        BadExperiment: a gap that is too long.
    """
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


def _row(text: list[str], where: str) -> list[float]:
    if len(text) != 8:
        raise BadExperiment(f"{where}: {len(text)} columns, expected 8: t x y z qx qy qz qw")
    try:
        return [float(number) for number in text]
    except ValueError as error:
        raise BadExperiment(f"{where}: {error}") from None
