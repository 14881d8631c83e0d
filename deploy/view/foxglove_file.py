"""What does Foxglove get to see? A recording of its own schemas: scenes, poses and errors. The only module that
imports foxglove."""

from collections.abc import Iterable
from pathlib import Path

import foxglove
import numpy as np
from foxglove import Channel
from foxglove.channels import SceneUpdateChannel
from foxglove.messages import (
    Color,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector3,
)
from matplotlib import colormaps

from agent.interface.frames import Array
from agent.interface.messages import STATES
from deploy.view.scene import Belief, Scene
from deploy.view.shapes import ellipsoids

Rgb = tuple[float, float, float]
WORLD = "world"
MAV_M = 0.54  # across
GREY = (0.5, 0.5, 0.5)
SEEN = 0.5  # explained to a larger part than to chance


def write(path: Path, mavs: int, scenes: Iterable[Scene]) -> None:
    """Topics /truth, /agents/I (what I believes and detects), and /state (of all, JSON: states and errors)."""
    context = foxglove.Context()
    ramp = colormaps["viridis"](np.linspace(0.15, 1.0, mavs))
    colors = [(float(r), float(g), float(b)) for r, g, b, _ in ramp]
    with foxglove.open_mcap(path, context=context):
        truth = SceneUpdateChannel("/truth", context=context)
        agents = {mav: SceneUpdateChannel(f"/agents/{mav}", context=context) for mav in range(1, mavs + 1)}
        state = Channel("/state", message_encoding="json", context=context)
        for scene in scenes:
            at_ns = round(scene.time_s * 1e9)
            truth.log(_update("truth", at_ns, **_mavs(scene.truth, colors)), log_time=at_ns)
            for mav, belief in scene.beliefs.items():
                agents[mav].log(_update(f"agent {mav}", at_ns, **_belief(mav, belief, colors)), log_time=at_ns)
            state.log({f"mav_{mav}": _state(mav, belief) for mav, belief in scene.beliefs.items()}, log_time=at_ns)


def _update(name: str, at_ns: int, **shapes: list[object]) -> SceneUpdate:
    stamp = Timestamp(at_ns // 10**9, at_ns % 10**9)
    return SceneUpdate(entities=[SceneEntity(timestamp=stamp, frame_id=WORLD, id=name, **shapes)])


def _mavs(poses: Array, colors: list[Rgb]) -> dict[str, list[object]]:
    there = [j for j in range(len(poses)) if np.isfinite(poses[j]).all()]
    size = Vector3(x=MAV_M, y=MAV_M, z=MAV_M / 4)
    return {
        "spheres": [SpherePrimitive(pose=_pose(poses[j]), size=size, color=_color(colors[j])) for j in there],
        "texts": [
            TextPrimitive(
                pose=_pose(poses[j] + [0, 0, 0.35, 0]),
                billboard=True,
                font_size=0.3,
                color=_color(colors[j]),
                text=str(j + 1),
            )
            for j in there
        ],
    }


def _belief(mav: int, belief: Belief, colors: list[Rgb]) -> dict[str, list[object]]:
    """Three-sigma ellipsoids, and lines to the detections: grey where nobody that is localised explains it."""
    known = [j for j in range(len(colors)) if np.isfinite(belief.poses[j]).all()]
    half, turns = ellipsoids(belief.covariances[known])
    spheres: list[object] = [
        SpherePrimitive(
            pose=_pose(belief.poses[j], turn), size=Vector3(x=2 * float(a[0]), y=2 * float(a[1]), z=2 * float(a[2])),
            color=_color(colors[j], 0.4),
        )
        for j, a, turn in zip(known, half, turns, strict=True)
    ]  # fmt: skip
    own, ends = belief.poses[mav - 1], zip(belief.detected, belief.explained, strict=True)
    lines: list[object] = [
        LinePrimitive(
            type=LinePrimitiveLineType.LineStrip, thickness=2.0, scale_invariant=True,
            points=[_point(own), _point(end)], color=_color(colors[mav - 1] if weight > SEEN else GREY),
        )
        for end, weight in ends
    ]  # fmt: skip
    return {"spheres": spheres, "lines": lines}


def _state(mav: int, belief: Belief) -> dict[str, object]:
    error = belief.error_m if np.isfinite(belief.error_m) else None
    others = {str(j + 1): STATES[state] for j, state in enumerate(belief.states.tolist()) if j != mav - 1}
    return {"states": others, "relative_error_m": error, "tick_ms": belief.tick_ms}


def _pose(pose: Array, turn: Array | None = None) -> Pose:
    x, y, z, w = turn if turn is not None else (0.0, 0.0, np.sin(pose[3] / 2), np.cos(pose[3] / 2))
    return Pose(
        position=Vector3(x=float(pose[0]), y=float(pose[1]), z=float(pose[2])),
        orientation=Quaternion(x=float(x), y=float(y), z=float(z), w=float(w)),
    )


def _color(rgb: Rgb, opacity: float = 1.0) -> Color:
    return Color(r=rgb[0], g=rgb[1], b=rgb[2], a=opacity)


def _point(place: Array) -> Point3:
    return Point3(x=float(place[0]), y=float(place[1]), z=float(place[2]))
