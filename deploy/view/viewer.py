"""How is a scene drawn in rerun? Entities, colours, views. The only module that imports rerun.

An entity holds all MAVs at once, so a tick costs a few calls an agent. Colours are MAVs', everywhere: a wrong identity
shows as a wrong colour.
"""

from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
from matplotlib import colormaps

from agent.interface.frames import Array
from agent.interface.messages import STATES
from deploy.view.scene import Belief, Scene
from deploy.view.shapes import ellipsoids

TIMELINE = "simulated time"
MAV_M = (0.27, 0.27, 0.06)  # half sizes: a MAV is 0.54 m across (the paper)
TRAIL_S = 10.0
TURNS = 5  # scenes in which an agent's trails are drawn once
OLD_S = 1.0  # a link whose newest packet is so old is dark
GREY, DARK = np.full(3, 130.0), np.full(3, 45.0)
STATE_COLORS = ((230, 159, 0), (240, 228, 66), (0, 114, 178))  # as on the page about a run


class Viewer:
    """Draws scenes into a stream that goes to a viewer, or a file."""

    def __init__(self, title: str, mavs: int) -> None:
        self._stream = rr.RecordingStream("swarm")
        self._stream.send_recording_name(title)
        self._mavs = mavs
        ramp = colormaps["viridis"](np.linspace(0.15, 1.0, mavs))
        self._colors = np.round(255 * ramp[:, :3])
        self._trails: dict[str, deque[tuple[float, Array]]] = {}
        self._states: dict[str, str] = {}
        self._drawn = 0
        self._haunted: dict[str, bool] = {}  # whether there are ghosts

    def connect(self, url: str) -> None:
        self._stream.connect_grpc(url)
        self._arrange()

    def save(self, path: Path) -> None:
        self._stream.save(path)
        self._arrange()

    def close(self) -> None:
        """Returns when everything is where it belongs."""
        self._stream.flush()
        self._stream.disconnect()

    def draw(self, scene: Scene) -> None:
        self._stream.set_time(TIMELINE, duration=scene.time_s)
        self._truth(scene)
        half, turns = ellipsoids(np.array([belief.covariances for belief in scene.beliefs.values()]))
        for index, (mav, belief) in enumerate(scene.beliefs.items()):
            self._belief(mav, belief, half[index], turns[index])
            self._trail(f"agents/{mav}/trails", scene.time_s, belief.poses[:, :3], self._drawn % TURNS == mav % TURNS)
        self._drawn += 1
        for path, name in (("errors", "error_m"), ("ticks", "tick_ms")):
            values = np.full(self._mavs, np.nan)
            for mav, belief in scene.beliefs.items():
                values[mav - 1] = getattr(belief, name)
            self._log(path, rr.Scalars(values))

    def _log(self, path: str, *what: Any, static: bool = False) -> None:
        self._stream.log(path, *what, static=static)

    def _truth(self, scene: Scene) -> None:
        places, yaw = scene.truth[:, :3], scene.truth[:, 3]
        nose = 0.45 * np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
        self._log("truth/mavs", rr.Ellipsoids3D.from_fields(centers=places))
        self._log("truth/heading", rr.Arrows3D.from_fields(vectors=nose, origins=places))
        self._trail("truth/trails", scene.time_s, places, True)
        self._log("links", self._links(scene))

    def _links(self, scene: Scene) -> rr.LineStrips3D:
        """From each receiver half the way to each sender, the darker the older its newest packet is."""
        apart = np.isfinite(scene.ages_s) & ~np.eye(self._mavs, dtype=bool)
        to, of = np.nonzero(apart & np.isfinite(scene.truth[:, :1]) & np.isfinite(scene.truth[:, 0]))
        ends = np.stack([scene.truth[to, :3], (scene.truth[to, :3] + scene.truth[of, :3]) / 2], axis=1)
        fresh = np.clip(1 - scene.ages_s[to, of] / OLD_S, 0, 1)[:, None]
        return rr.LineStrips3D.from_fields(strips=ends, colors=packed(DARK + fresh * (190 - DARK)))

    def _belief(self, mav: int, belief: Belief, half: Array, turns: Array) -> None:
        path, known, places = f"agents/{mav}", np.isfinite(belief.poses[:, 0]), belief.poses[:, :3]
        self._log(
            f"{path}/mavs",
            rr.Points3D.from_fields(positions=places),
            rr.Ellipsoids3D.from_fields(half_sizes=half, centers=places, quaternions=turns),
        )
        rays = np.stack([np.broadcast_to(places[mav - 1], belief.detected.shape), belief.detected], axis=1)
        shade = GREY + belief.explained[:, None] * (self._colors[mav - 1] - GREY)
        self._log(f"{path}/detections", rr.LineStrips3D.from_fields(strips=rays, colors=packed(shade)))
        self._rivals(f"{path}/rivals", belief, known)
        others = np.delete(belief.states, mav - 1)
        self._change(f"states/{mav}", STATES[others.min(initial=len(STATES) - 1)])

    def _rivals(self, path: str, belief: Belief, known: npt.NDArray[np.bool_]) -> None:
        """The less a hypothesis weighs, the smaller its ghosts."""
        which, whom = np.nonzero(np.isfinite(belief.rivals[..., 0]) & ~known)
        if not len(which) and not self._haunted.get(path):
            return
        self._haunted[path] = bool(len(which))
        sizes = np.multiply.outer(0.4 + 0.6 * belief.rival_weights[which], MAV_M)
        places, colors = belief.rivals[which, whom, :3], packed(self._colors[whom])
        self._log(path, rr.Ellipsoids3D(half_sizes=sizes, centers=places, colors=colors, line_radii=0.006))

    def _change(self, path: str, state: str) -> None:
        if self._states.get(path) != state:
            self._states[path] = state
            self._log(path, rr.StateChange(state=state))

    def _trail(self, path: str, time_s: float, places: Array, now: bool) -> None:
        """Drawn now, or only remembered: it is the most that is to be sent, and changes least."""
        trail = self._trails.setdefault(path, deque())
        trail.append((time_s, places))
        while trail[0][0] < time_s - TRAIL_S:
            trail.popleft()
        if not now:
            return
        way = np.stack([place for _, place in trail], axis=1)  # (N, K, 3)
        self._log(path, rr.LineStrips3D.from_fields(strips=[each[np.isfinite(each[:, 0])] for each in way]))

    def _arrange(self) -> None:
        """What does not change: colours, sizes, names and the views."""
        colors, names = packed(self._colors), [str(mav) for mav in range(1, self._mavs + 1)]
        solid = rr.Ellipsoids3D.from_fields(
            half_sizes=[MAV_M] * self._mavs, colors=colors, labels=names, fill_mode="solid"
        )
        styles: dict[str, Any] = {
            "truth/mavs": solid,
            "truth/heading": rr.Arrows3D.from_fields(colors=colors, radii=0.02),
            "truth/trails": rr.LineStrips3D.from_fields(colors=colors, radii=0.01),
            "links": rr.LineStrips3D.from_fields(radii=0.004),
            "errors": rr.SeriesLines(colors=colors, names=[f"MAV {name}" for name in names]),
            "ticks": rr.SeriesLines(colors=colors, names=[f"MAV {name}" for name in names]),
        }
        states = rr.StateConfiguration(values=STATES, labels=STATES, colors=packed(np.array(STATE_COLORS)))
        for name in names:
            styles |= {
                f"agents/{name}/mavs": (
                    rr.Points3D.from_fields(colors=colors, radii=0.07),
                    rr.Ellipsoids3D.from_fields(colors=colors, line_radii=0.004),
                ),
                f"agents/{name}/trails": rr.LineStrips3D.from_fields(colors=colors, radii=0.006),
                f"agents/{name}/detections": rr.LineStrips3D.from_fields(radii=0.008),
                f"states/{name}": states,
            }
        for path, style in styles.items():
            self._log(path, *(style if isinstance(style, tuple) else (style,)), static=True)
        self._stream.send_blueprint(arrangement(self._mavs))


def arrangement(mavs: int) -> rrb.Blueprint:
    """The team beside its states, errors and costs; then one agent's beliefs at a time."""
    agents = range(1, mavs + 1)
    believed = [f"/agents/{mav}/{what}" for mav in agents for what in ("mavs", "rivals")]
    team = rrb.Spatial3DView(name="team", origin="/", contents=["/truth/**", "/links", *believed])
    alone = [
        rrb.Spatial3DView(name=f"agent {mav}", origin="/", contents=["/truth/mavs", f"/agents/{mav}/**"])
        for mav in agents
    ]
    plots = rrb.Vertical(
        rrb.StateTimelineView(origin="/states", name="whom each has localised: the least known"),
        rrb.TimeSeriesView(origin="/errors", name="relative position error [m]"),
        rrb.TimeSeriesView(origin="/ticks", name="tick of the estimator [ms]"),
        row_shares=[1, 1, 1],
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(team, *alone, active_tab=0), plots, column_shares=[2, 1]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def packed(colors: Array) -> npt.NDArray[np.uint32]:
    """(n,) 0xRRGGBBAA of opaque colours (n, 3), 0 to 255."""
    red, green, blue = np.asarray(colors).astype(np.uint32).T
    return np.asarray(red << 24 | green << 16 | blue << 8 | 255, np.uint32)


def write(path: Path, title: str, mavs: int, scenes: Iterable[Scene]) -> None:
    """A recording for rerun (.rrd), which its next version reads, too."""
    viewer = Viewer(title, mavs)
    viewer.save(path)
    for scene in scenes:
        viewer.draw(scene)
    viewer.close()
