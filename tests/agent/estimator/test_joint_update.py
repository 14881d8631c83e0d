"""All unambiguous sets at once, against every hypothesis of the whole tick, and against one by one."""

from itertools import permutations, product

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.estimator.cpdaf import Rules
from agent.estimator.detection_model import cartesian
from agent.estimator.estimator import Estimator
from agent.estimator.innovations import Innovations
from agent.estimator.joint_update import DetectionSet, joint_update
from agent.estimator.state import Poses
from agent.estimator.station_update import Pairs
from agent.interface.fleet import Fleet
from agent.interface.frames import rotate_z
from agent.interface.sensors import Detector
from tests import team
from tests.agent.estimator.test_estimator import anees, fly

DETECTOR = Detector()
RULES = Rules(gate_threshold=21.0, evaluation=True, pruned_mass=1e-6)


def jointly(poses, sets, clutter=DETECTOR.clutter_density, rules=RULES):
    pairs = Pairs.at(poses, DETECTOR)
    found = Innovations.of(poses, pairs, [s.station - 1 for s in sets], [s.spherical for s in sets])
    return joint_update(poses, pairs, sets, found, clutter, rules)


def tick_in_flight(seed, mavs, ticks=12):
    """Poses before the last tick's sets, and these sets."""
    rng = np.random.default_rng(seed)
    estimator = Estimator(AgentConfig(), Fleet(mavs=mavs), 1)
    for k, tick in enumerate(team.circling(rng, mavs, ticks)):
        if k == 0:
            estimator.start(team.frames_in(tick.truth, 1), 0.2, 0.1)
        estimator.predict(tick.odometry)
        poses = estimator.poses
        sets = [DetectionSet(i, tick.sets[i]) for i in range(1, mavs + 1)]
        estimator.associate_all(sets)
        estimator.finish()
    return Poses(poses.y.copy(), poses.Sigma.copy()), sets, tick


def every_hypothesis_of_the_tick(poses, sets, rules):
    """Moment-matched mixture of one Kalman update per combination of the stations' hypotheses, and its reach."""
    pairs = Pairs.at(poses, DETECTOR)
    bodies = len(poses.y) // 4
    rows = {}
    per_station = []
    for station, spherical, _ in sets:
        s = station - 1
        z = rotate_z(poses.by_body[s, 3], cartesian(spherical))
        targets = [t for t in range(bodies - 1) if t != s]
        admitted = {}
        for t in targets:
            H = np.zeros((3, bodies, 4))
            H[:, t, :3], H[:, s, :3] = np.eye(3), -np.eye(3)
            H[:, s, 3] = [pairs.lines[s, t, 1], -pairs.lines[s, t, 0], 0]
            H = H.reshape(3, -1)
            S = H @ poses.Sigma @ H.T + pairs.R[s, t]
            for m in range(len(z)):
                nu = z[m] - pairs.lines[s, t]
                if nu @ np.linalg.solve(S, nu) <= rules.gate_threshold:
                    admitted[t, m] = nu
            rows[s, t] = H
        options = []
        for phi in product((False, True), repeat=len(targets)):
            chosen = [t for t, is_in in zip(targets, phi, strict=True) if is_in]
            for ms in permutations(range(len(z)), len(chosen)):
                if all((t, m) in admitted for t, m in zip(chosen, ms, strict=True)):
                    options.append([(s, t, admitted[t, m]) for t, m in zip(chosen, ms, strict=True)])
        per_station.append((len(targets), len(z), options))
    means, covariances, logs = [], [], []
    for combination in product(*(options for _, _, options in per_station)):
        log = 0.0
        for (L, M, _), edges in zip(per_station, combination, strict=True):
            D = len(edges)
            log += D * np.log(DETECTOR.P_D) + (L - D) * np.log(1 - DETECTOR.P_D)
            log += (M - D) * np.log(DETECTOR.clutter_density)
        edges = [edge for station in combination for edge in station]
        y, P = poses.y, poses.Sigma
        if edges:
            H = np.vstack([rows[s, t] for s, t, _ in edges])
            nu = np.concatenate([n for _, _, n in edges])
            S = H @ poses.Sigma @ H.T
            for k, (s, t, _) in enumerate(edges):
                S[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += pairs.R[s, t]
            log += -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])
            K = poses.Sigma @ H.T @ np.linalg.inv(S)
            y, P = y + K @ nu, P - K @ S @ K.T
        means.append(y)
        covariances.append(P)
        logs.append(log)
    beta = np.exp(np.array(logs) - max(logs))
    beta /= beta.sum()
    mean = beta @ np.array(means)
    spread = np.array(means) - mean
    P = np.tensordot(beta, np.array(covariances), 1) + (spread * beta[:, None]).T @ spread
    return mean, P, np.abs(spread).max()


@pytest.mark.parametrize("seed", range(12))
def test_it_equals_every_hypothesis_of_the_whole_tick_within_the_lost_mass(seed):
    poses, sets, _ = tick_in_flight([11, seed], mavs=3)
    joint = jointly(poses, sets)
    taken = [s for s in sets if s.station not in {left.station for left in joint.left}]
    assert taken
    mean, P, reach = every_hypothesis_of_the_tick(poses, taken, RULES)
    allowed = 4 * joint.lost_mass + 1e-10
    assert np.abs(joint.poses.y - mean).max() <= allowed * max(reach, 1e-3)
    assert np.abs(joint.poses.Sigma - P).max() <= allowed * max(reach**2, 1e-3)


@pytest.mark.parametrize("seed", range(6))
def test_single_misses_are_weighed_in(seed):
    """With much clutter the odds of a false detection matter; two at once are still rare."""
    noisy = Rules(21.0, True, 1e-4)
    poses, sets, _ = tick_in_flight([12, seed], mavs=3)
    joint = jointly(poses, sets, 1.0, noisy)
    alone = jointly(poses, sets, 1e-9, noisy)
    assert joint.lost_mass < 1e-4
    assert np.trace(joint.poses.Sigma) > np.trace(alone.poses.Sigma)


@pytest.mark.parametrize("seed", range(5))
def test_it_is_close_to_one_by_one(seed):
    estimators = []
    for one_by_one in (False, True):
        rng = np.random.default_rng([13, seed])
        estimator = Estimator(AgentConfig(), Fleet(mavs=7), 1)
        for k, tick in enumerate(team.circling(rng, 7, 30)):
            if k == 0:
                estimator.start(team.frames_in(tick.truth, 1), 0.2, 0.1)
            estimator.predict(tick.odometry)
            if one_by_one:
                for i, spherical in tick.sets.items():
                    estimator.associate(i, spherical)
            else:
                estimator.associate_all([DetectionSet(i, s) for i, s in tick.sets.items()])
            beliefs = estimator.finish()
        estimators.append(beliefs)
    at_once, single = estimators
    assert np.abs(at_once.poses - single.poses).max() < 3e-3
    np.testing.assert_allclose(at_once.covariances, single.covariances, rtol=0.1, atol=1e-5)


def test_an_ambiguous_set_is_left_for_later():
    poses, sets, _ = tick_in_flight([14, 0], mavs=4)
    doubled = np.vstack([sets[1].spherical, sets[1].spherical[:1]])  # two detections in one gate
    sets[1] = DetectionSet(2, doubled)
    joint = jointly(poses, sets)
    assert 2 in [s.station for s in joint.left]


def test_told_the_truth_it_takes_every_set():
    poses, sets, tick = tick_in_flight([15, 0], mavs=4)
    sets = [DetectionSet(s.station, s.spherical, tick.labels[s.station]) for s in sets]
    joint = jointly(poses, sets)
    assert joint.left == []
    assert len(joint.distances) == sum((s.labels > 0).sum() for s in sets)


@pytest.mark.parametrize("sets", [[], [DetectionSet(1, np.zeros((0, 3))), DetectionSet(2, np.zeros((0, 3)))]])
def test_nothing_seen_changes_nothing(sets):
    poses, _, _ = tick_in_flight([16, 0], mavs=3)
    joint = jointly(poses, sets)
    assert joint.poses is poses
    assert joint.left == []


@pytest.mark.parametrize("seed", range(5))
def test_the_covariance_stays_positive_and_symmetric(seed):
    poses, sets, _ = tick_in_flight([17, seed], mavs=7)
    P = jointly(poses, sets).poses.Sigma
    assert np.abs(P - P.T).max() < 1e-12
    assert np.linalg.eigvalsh(P).min() > 0


@pytest.mark.statistical
def test_it_is_as_consistent_as_one_by_one():
    values = [anees(*fly([7, seed], at_once=True)[:2]) for seed in range(20)]
    assert 0.83 < np.mean(values) < 1.19
