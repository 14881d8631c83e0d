"""A team of which nothing is known yet: random places, what one station hears of them, where they really are.

Arrays are in the station's order, as in `agent/registration`: itself first, then the others.
"""

import numpy as np

from agent.estimator.gating import chi_square_quantile
from agent.interface.frames import compose, inverse, range_and_bearing, relative_pose
from agent.interface.sensors import Detector
from agent.registration.bank import Bank, Team
from agent.registration.candidates import Placement
from agent.registration.hypotheses import Hypotheses
from agent.registration.window import Window
from tests import team

SURE = Detector(P_D=0.999, false_per_set=1e-6)
SEEDS = 20  # of a statistical test of four MAVs, and where the mean NEES per dimension of their first estimates lies
CONSISTENT = [chi_square_quantile(p, SEEDS * 12) / (SEEDS * 12) for p in (0.005, 0.995)]


def box(rng, mavs, size=(8.0, 8.0, 1.5)):
    """(N, 3) random places, 1 m apart."""
    while True:
        places = rng.uniform(-0.5, 0.5, (mavs, 3)) * size
        apart = np.linalg.norm(places[:, None] - places, axis=2) + 9 * np.eye(mavs)
        if apart.min() > 1:
            return places


def hovering(seed, mavs, ticks, places=None, **sensors):
    """Ticks of a team that stays where it is, in a random box if nothing else is said."""
    rng = np.random.default_rng(seed)
    places = box(rng, mavs) if places is None else np.asarray(places)
    return list(team.fly(rng, mavs, ticks, lambda t: places, **sensors))


def wandering(seed, mavs, ticks, **sensors):
    """Ticks of a team of which everybody flies small circles of his own."""
    rng = np.random.default_rng(seed)
    places, phase, speed = box(rng, mavs), rng.uniform(-np.pi, np.pi, mavs), rng.uniform(0.5, 1.5, mavs)

    def at(t):
        angle = phase + speed * t
        return places + 0.4 * np.column_stack([np.cos(angle), np.sin(angle), np.sin(angle / 2)])

    return list(team.fly(rng, mavs, ticks, at, **sensors))


def exact(rng, mavs, ticks, moving=True):
    """Ticks without noise, misses and false detections, of MAVs that move and turn; odometry began anywhere."""
    first = np.column_stack([box(rng, mavs), rng.uniform(-np.pi, np.pi, mavs)])
    velocity = np.column_stack([rng.uniform(-1, 1, (mavs, 3)), rng.uniform(-1, 1, mavs)]) * moving
    origins = np.column_stack([rng.uniform(-5, 5, (mavs, 3)), rng.uniform(-np.pi, np.pi, mavs)])
    every = np.arange(mavs)
    for k in range(ticks):
        truth = first + 0.1 * k * velocity
        readings = compose(inverse(origins), truth)
        sets = {}
        for i in range(mavs):
            seen = relative_pose(np.tile(truth[i], (mavs, 1)), truth)[rng.permutation(every[every != i])]
            sets[i + 1] = range_and_bearing(seen[:, :3])
        labels = dict.fromkeys(sets, np.zeros(0, int))
        yield team.Tick(truth, {i + 1: readings[i] for i in range(mavs)}, sets, labels)


def order(mavs, station=1):
    """MAV numbers by index."""
    return [station, *(mav for mav in range(1, mavs + 1) if mav != station)]


def heard(tick, station=1):
    """What comes in of a tick: odometry and detection sets, by index."""
    ids = order(len(tick.truth), station)
    return {k: tick.odometry[mav] for k, mav in enumerate(ids)}, {k: tick.sets[mav] for k, mav in enumerate(ids)}


def window_of(ticks, station=1, length=40):
    window = Window(len(ticks[0].truth), length)
    for k, tick in enumerate(ticks):
        odometry, sets = heard(tick, station)
        frame = window.add(k, odometry)
        for index, spherical in sets.items():
            frame.put(index, spherical)
    return window


def true_poses(tick, station=1):
    """(N, 4) where everybody is in the station's odometry frame, now that it reads what it reads."""
    ids = order(len(tick.truth), station)
    truth = tick.truth[[mav - 1 for mav in ids]]
    own = np.tile(tick.odometry[station], (len(ids), 1))
    return compose(own, relative_pose(np.tile(truth[0], (len(ids), 1)), truth))


def placement(poses, placed=None):
    """Of everybody at these poses (N, 4), or of some."""
    mavs = len(poses)
    placed = np.ones(mavs, bool) if placed is None else np.asarray(placed, bool)
    return Placement(poses.copy(), np.tile(1e-4 * np.eye(4), (mavs, 1, 1)), placed)


def alone(odometry, mavs):
    """A station that knows of nobody but itself and, nearly, of where it began."""
    y = np.zeros((mavs + 1, 4))
    y[0] = odometry
    P = np.zeros((4 * mavs, 4 * mavs))
    P[-4:, -4:] = 1e-6 * np.eye(4)
    return Team(y, P, np.arange(mavs) == 0)


def bank_at(hypotheses, sigma_m=0.1, sigma_rad=0.05):
    """A bank of K hypotheses that place everybody at these poses (K, N, 4)."""
    K, N = np.shape(hypotheses)[:2]
    y = np.concatenate([hypotheses, np.zeros((K, 1, 4))], axis=1)
    sigma = np.tile([sigma_m] * 3 + [sigma_rad], N)
    return Bank(y, np.tile(np.diag(sigma**2), (K, 1, 1)), np.ones((K, N), bool))


def finished(job):
    """What a sliced job returns, and what it says that it has cost."""
    spent = 0.0
    while True:
        try:
            spent += next(job)
        except StopIteration as end:
            return end.value, spent


def recorded(hypotheses, evidence, placed=None):
    """Hypotheses of these poses (K, N, 4) that have earned this (K, T) in the last T ticks, and fit well."""
    K, N = np.shape(hypotheses)[:2]
    bank = bank_at(hypotheses)
    if placed is not None:
        bank.placed[:] = placed
    made = Hypotheses.fresh(bank, range(K))
    ticks = np.shape(evidence)[1]
    if ticks:
        made.evidence[:, -ticks:] = evidence
    pairs = bank.placed[:, :, None] & bank.placed[:, None] & ~np.eye(N, dtype=bool)
    made.expected, made.explained = 20.0 * pairs, 18.0 * pairs
    made.square, made.events = np.full(K, 3000.0), np.full(K, 1000.0)
    return made
