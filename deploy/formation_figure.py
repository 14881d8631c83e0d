"""What did the team fly? Its paths from above and from the side, and how near it came to its formations."""

from pathlib import Path
from typing import BinaryIO

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.figure import Figure

from agent.interface.frames import Array, compose, inverse, rotate_z
from deploy.formation import held_at
from deploy.recording import Recording, pose_of
from deploy.report import SMALL
from deploy.summary import Analysis


def draw_formation(analysis: Analysis, experiment: str, file: Path | BinaryIO) -> None:
    """From above, from the side, and the distance to the desired relative positions over time."""
    recording, found = analysis.recording, analysis.shapes or []
    desired = _desired(recording)
    time_s, positions, intents = recording.time_s, recording.truth[..., :3], recording.intents
    with rc_context(SMALL):
        figure = Figure(figsize=(10.5, 4.2), layout="constrained")
        above, aside, course = figure.subplots(1, 3, width_ratios=(1.1, 0.9, 1.1))
        for i in range(positions.shape[1]):
            color = colormaps["viridis"](i / max(positions.shape[1] - 1, 1) * 0.9)
            for axis, across in ((above, (0, 1)), (aside, (0, 2))):
                flown = positions[:, i, across]
                axis.plot(*flown.T, color=color, linewidth=1.0, label=f"MAV {i + 1}" if axis is above else None)
                axis.plot(*desired[:, i, across].T, color="0.2", linewidth=0.6, linestyle=(0, (2, 3)))
                axis.plot(*flown[0], marker="o", markersize=4, color=color)
        last = {int(intents.formation[k].max()): k for k in held_at(found, intents)}  # tick of each formation
        for k in last.values():
            shape = found[k]
            assert shape is not None
            for axis, across in ((above, (0, 1)), (aside, (0, 2))):
                axis.plot(*shape.goals[:, across].T, "x", color="0.2", markersize=6, zorder=3)
        for axis, name in ((above, "y [m]"), (aside, "z [m]")):
            axis.set_xlabel("x [m]")
            axis.set_ylabel(name)
            axis.set_aspect("equal", adjustable="datalim")
        above.set_title("from above: ● start, ┄ and × desired")
        aside.set_title("from the side")
        above.legend(fontsize=6, ncols=2)
        rms = np.array([np.nan if shape is None else shape.rms_m for shape in found])
        course.semilogy(time_s, rms, color="#0072B2")
        course.set_xlabel("simulated time [s]")
        course.set_title("RMS distance to the desired relative positions [m]")
        figure.suptitle(experiment)
        figure.savefig(file, dpi=120, format="png")


def _desired(recording: Recording) -> Array:
    """(K, N, 3) m in world: where each MAV was commanded to be, by its own odometry as that was then."""
    frames = compose(recording.true_poses, inverse(pose_of(recording.vio)))
    return np.asarray(frames[..., :3] + rotate_z(frames[..., 3], recording.wanted))
