"""Which starts can be decided, and how fast? Nats per tick by which the truth beats its best rival; draws the README's
figure.

Run by `make decidable`. For every start a team hovers; the truth is carried as a hypothesis, the best exchanges of
identity on its places are carried beside it, and their evidence is compared.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from agent.config import AgentConfig
from agent.registration import places
from agent.registration.bank import Filter, Team, begin
from agent.registration.candidates import Placement
from agent.registration.hypotheses import LEAST_SIGMA, Hypotheses, elsewhere, from_station
from agent.registration.window import Window
from tests import team

PICTURE = Path(__file__).parents[2] / "deploy" / "pictures" / "decidable.png"
SEEDS = 10
BEFORE, AFTER, RIVALS = 12, 12, 6  # ticks until the rivals are made, and for which they compete; how many
CONFIG = AgentConfig()


def box(mavs):
    def places_of(rng):
        while True:
            p = rng.uniform(0, 1, (mavs, 3)) * (8.0, 8.0, 1.5)
            if np.linalg.norm(p[:, None] - p[None] + 9 * np.eye(mavs)[..., None], axis=-1).min() > 1:
                return p

    return places_of


def circle(radius_m, jitter_m=0.0, step_m=0.0):
    angle = 2 * np.pi * np.arange(7) / 7
    p = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), step_m * np.arange(7)])
    return lambda rng: p + rng.normal(0, 1, p.shape) * jitter_m


def line(jitter_m):
    p = np.column_stack([np.zeros(7), np.linspace(-3, 3, 7), np.zeros(7)])
    return lambda rng: p + rng.normal(0, 1, p.shape) * jitter_m


def v(rng):
    rank, side = (np.arange(7) + 1) // 2, np.where(np.arange(7) % 2, 1.0, -1.0)
    return np.column_stack([-rank, side * rank, np.zeros(7)])


STARTS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "random box 8 x 8 x 1.5 m, 12 MAVs": box(12),
    "random box, 7 MAVs": box(7),
    "random box, 3 MAVs": box(3),
    "line of 6 m, jitter 0.1 m": line(0.1),
    "v, regular": v,
    "circle of 2.7 m, jitter 0.3 m": circle(2.7, 0.3),
    "circle of 1.35 m, jitter 0.1 m": circle(1.35, 0.1),
    "the same, jitter 0.02 m": circle(1.35, 0.02),
    "the same, jitter 0.01 m": circle(1.35, 0.01),
    "regular circle, heights 0.15 m apart": circle(1.35, step_m=0.15),
    "the same, 0.05 m apart": circle(1.35, step_m=0.05),
    "regular line of 6 m": line(0.0),
    "regular circle of 1.35 m": circle(1.35),
}


def nats_per_tick(start, seed: int) -> float:
    """Mean over ticks by which the truth beats the best of its rivals."""
    rng = np.random.default_rng(seed)
    where = start(rng)
    mavs = len(where)
    window = Window(mavs, BEFORE + AFTER)
    truth = np.zeros((mavs, 4))
    for k, tick in enumerate(team.fly(rng, mavs, BEFORE + AFTER, lambda _: where, CONFIG.detector, CONFIG.odometry)):
        frame = window.add(k, {i: tick.odometry[i + 1] for i in range(mavs)})
        for i in range(mavs):
            frame.put(i, tick.sets[i + 1])
        truth = tick.truth
    frames = window.frames
    sight = Filter(CONFIG, mavs, 10.0)
    alone = Team(np.zeros((mavs + 1, 4)), np.diag([1e-9] * 4 * mavs), np.arange(mavs) == 0)
    everybody = np.ones(mavs, bool)

    def carried(poses, first: int, until: int) -> Hypotheses:
        made = [Placement(each, np.zeros((mavs, 4, 4)), everybody) for each in poses]
        alone.y[0] = frames[first].odometry[0]
        found = Hypotheses.fresh(begin(made, alone, frames[first], frames[first]), range(len(made)))
        found.note(sight.update(found.bank, frames[first], 3), burn_in=True)
        for before, frame in zip(frames[first:until], frames[first + 1 : until + 1], strict=False):
            found.note(sight.step(found.bank, before, frame))
        return found

    right = carried(from_station(truth[None]), 0, BEFORE)
    now, past = right.track[0, -1], right.track[0, -places.FRAMES :]
    P = np.zeros((mavs, 4, mavs, 4))
    P[1:, :, 1:] = right.bank.P[0].reshape(mavs, 4, mavs, 4)[:-1, :, :-1]
    view = done(
        places.place_view(
            CONFIG, frames[BEFORE + 1 - places.FRAMES : BEFORE + 1], np.arange(mavs), past, P[:, :3, :, :3]
        )
    )
    poses = places.rivals(view, now, 1e5).poses
    differs = elsewhere(from_station(now[None]), everybody, from_station(poses), everybody)
    others = poses[differs.any(axis=1)][:RIVALS]
    rivals = carried(others, BEFORE, BEFORE + AFTER - 1)
    for before, frame in zip(frames[BEFORE:], frames[BEFORE + 1 :], strict=False):
        right.note(sight.step(right.bank, before, frame))
    scored = slice(-(AFTER - 3), None)  # the rivals have settled
    return float((right.evidence[0, scored].mean() - rivals.evidence[:, scored].mean(axis=1)).min())


def done(generator):
    """What a generator returns."""
    while True:
        try:
            next(generator)
        except StopIteration as end:
            return end.value


def main() -> int:
    fig, axes = plt.subplots(figsize=(8.2, 4.6), layout="constrained")
    axes.axvspan(-5, LEAST_SIGMA, color="0.85", lw=0)
    for row, (name, start) in enumerate(STARTS.items()):
        nats = np.array([nats_per_tick(start, seed) for seed in range(SEEDS)])
        axes.plot(nats, np.full(SEEDS, row), "o", color="#0072B2", ms=4, alpha=0.5, mec="none")
        axes.plot(np.median(nats), row, "|", color="black", ms=13, mew=2)
        print(f"{name:40} median {np.median(nats):7.1f}, least {nats.min():7.1f} nats a tick", flush=True)
    axes.set_yticks(range(len(STARTS)), STARTS)
    axes.invert_yaxis()
    axes.set_xscale("symlog", linthresh=10, linscale=1.0)
    axes.set_xlim(-5, 500)
    axes.set_xticks([0, 3, 10, 30, 100, 300], ["0", "3", "10", "30", "100", "300"])
    axes.set_xlabel(f"nats a tick by which the truth beats its best rival (seeds 0 to {SEEDS - 1}; bars: median)")
    axes.text(-1.2, len(STARTS) - 3.2, "what chance makes\nof equals", fontsize=8, ha="center", color="0.3")
    axes.grid(axis="x", color="0.92")
    axes.set_axisbelow(True)
    axes.set_title("Hovering, P_D 0.9, 0.5 false detections a set, 10 Hz", fontsize=9)
    fig.savefig(PICTURE, dpi=130)
    print(PICTURE.name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
