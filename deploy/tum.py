"""Which trajectory files does a run leave? TUM format, as other tools read it: `t x y z qx qy qz qw`.

What agent I believes is given in the frame that stays where I's odometry began. I's own odometry frame is there at
the start and drifts away from it; how far, I estimates, too.
"""

from pathlib import Path

import numpy as np

from agent.interface.frames import Array
from deploy import commits, metrics
from deploy.recording import Recording


def export(recording: Recording, folder: Path) -> None:
    """Writes truth/, vio/ and estimate/agent_I/; an estimate begins when agent I first calls MAV J localised."""
    absolute = recording.beliefs.absolute
    since_s = commits.localised_since(recording.beliefs.states, recording.time_s)
    for mav in recording.fleet.ids:
        _write(folder / "truth" / f"mav_{mav}.tum", recording.time_s, recording.truth[:, mav - 1])
        _write(folder / "vio" / f"mav_{mav}.tum", recording.time_s, recording.vio[:, mav - 1])
    for agent in recording.fleet.ids:
        for mav in recording.fleet.ids:
            begun = recording.time_s >= since_s[agent - 1, mav - 1]
            poses = with_quaternion(absolute[begun, agent - 1, mav - 1])
            _write(folder / "estimate" / f"agent_{agent}" / f"mav_{mav}.tum", recording.time_s[begun], poses)


def export_references(recording: Recording, folder: Path) -> None:
    """Writes reference/agent_I/mav_J.tum: the true pose of J in the frame of the estimates of agent I, at all times."""
    origins = metrics.origins_of_lives(recording.true_poses, recording.odometry, recording.incarnations)
    true = metrics.absolute_from_world(origins, recording.true_poses)
    for agent in recording.fleet.ids:
        for mav in recording.fleet.ids:
            poses = with_quaternion(true[:, agent - 1, mav - 1])
            _write(folder / "reference" / f"agent_{agent}" / f"mav_{mav}.tum", recording.time_s, poses)


def with_quaternion(poses: Array) -> Array:
    """(..., 4) x y z m, yaw rad as (..., 7) with the quaternion x y z w of a turn about z."""
    half, level = poses[..., 3] / 2, np.zeros(poses.shape[:-1])
    quaternion = np.stack([level, level, np.sin(half), np.cos(half)], axis=-1)
    return np.concatenate([poses[..., :3], quaternion], axis=-1)


def _write(path: Path, time_s: Array, poses: Array) -> None:
    known = np.isfinite(poses).all(axis=-1)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.column_stack([time_s, poses])[known], fmt="%.9f")
