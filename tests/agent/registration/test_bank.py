"""The bank's small filter against the estimator's, against a plain Kalman update, and against the truth."""

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.config import Filter as FilterConfig
from agent.estimator.moments import pose_moments
from agent.estimator.prediction import predict
from agent.estimator.state import from_frames
from agent.interface.frames import range_and_bearing, relative_pose, wrap
from agent.interface.sensors import Detector
from agent.registration.bank import Bank, Filter, begin
from agent.registration.window import Window
from tests.agent.registration.beginning import (
    SURE,
    alone,
    bank_at,
    exact,
    heard,
    order,
    placement,
    true_poses,
    window_of,
)

RATE_HZ = 10.0
PRECISE = FilterConfig(odometry_sigma_m=1e-6, odometry_sigma_rad=1e-6)


def random_covariance(rng, n, sigma):
    root = rng.normal(size=(4 * n, 4 * n)) / np.sqrt(4 * n)
    return root @ root.T * np.outer(np.tile(sigma, n), np.tile(sigma, n))


def as_bank(state, ids):
    """What the estimator's state says of the poses, in the registration's order, the station pinned."""
    poses, rows = pose_moments(state).poses, [*(mav - 1 for mav in ids), len(ids)]
    entries = [4 * row + k for row in rows[1:] for k in range(4)]
    y, P = poses.by_body[rows], poses.Sigma[np.ix_(entries, entries)]
    return Bank(y[None].copy(), P[None].copy(), np.ones((1, len(ids)), bool))


@pytest.mark.parametrize(("moving", "allowed"), [(False, 1e-9), (True, 1e-4)], ids=["in hover", "in flight"])
@pytest.mark.parametrize("station", [1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_it_moves_as_the_estimator_does(seed, station, moving, allowed):
    """Several ticks of drift and motion, from a state that is correlated; the two turn a frame before and after it."""
    rng = np.random.default_rng([1, seed])
    mavs, config = 4, AgentConfig(filter=PRECISE)
    ids = order(mavs, station)
    ticks = list(exact(rng, mavs, 5, moving))
    readings = [np.array([*(tick.odometry[i] for i in range(1, mavs + 1)), np.zeros(4)]) for tick in ticks]
    frames = np.column_stack([rng.normal(size=(mavs + 1, 3)) * 3, rng.uniform(-3, 3, mavs + 1)])
    frames[[station - 1, mavs]] = 0.0
    state = from_frames(frames, readings[0], station, (0.1, 0.02), (1e-7, 1e-7))
    window = window_of(ticks, station)
    sight, bank = Filter(config, mavs, RATE_HZ), as_bank(state, ids)
    before = bank.P.copy()
    drift = (config.odometry.position_sigma_m, config.odometry.yaw_sigma_rad)
    for k in range(1, 5):
        increments = readings[k] - readings[k - 1]
        increments[:, 3] = wrap(increments[:, 3])
        state = predict(state, increments, np.full((mavs + 1, 2), 1e-7), drift)
        sight.predict(bank, window.frames[k - 1], window.frames[k])
    expected = as_bank(state, ids)
    np.testing.assert_allclose(bank.y[..., :3], expected.y[..., :3], atol=1e-9)
    np.testing.assert_allclose(wrap(bank.y[..., 3] - expected.y[..., 3]), 0, atol=1e-9)
    np.testing.assert_allclose(bank.P, expected.P, atol=allowed)
    assert np.abs(bank.P - before).max() > 10 * allowed
    assert np.abs(bank.P[0, :4, 4:8]).max() > 1e-5  # the station's drift is everybody's


def test_who_is_not_heard_grows_unsure():
    window = Window(3, 40)
    for k in range(3):
        window.add(k, {j: np.zeros(4) for j in range(3) if not (j == 2 and k == 1)})
    sight, bank = Filter(AgentConfig(), 3, RATE_HZ), bank_at(np.zeros((1, 3, 4)))
    grown = []
    for k in (1, 2):  # an increment takes two readings
        before = bank.P[0].diagonal().copy()
        sight.predict(bank, window.frames[k - 1], window.frames[k])
        grown.append((bank.P[0].diagonal() - before).reshape(3, 4))
    for each in grown:
        assert each[1, 0] > each[0, 0] + 0.9 * 0.05**2  # 0.5 m/s at 10 Hz
        assert each[1, 3] > each[0, 3] + 0.9 * 0.05**2


def scene(rng, mavs, detector, sigma_m=0.03, sigma_rad=0.01, misses=0):
    """A prior of one hypothesis, and a tick drawn from it: bank, frame, which detections are of whom."""
    truth = np.column_stack([rng.uniform(-4, 4, (mavs, 3)), rng.uniform(-np.pi, np.pi, mavs)])
    while np.linalg.norm(truth[:, None, :3] - truth[:, :3], axis=2)[np.triu_indices(mavs, 1)].min() < 1.5:
        truth[:, :3] = rng.uniform(-4, 4, (mavs, 3))
    P = random_covariance(rng, mavs, [sigma_m] * 3 + [sigma_rad]) + 1e-6 * np.eye(4 * mavs)
    prior = truth.copy()
    prior[1:] += (np.linalg.cholesky(P) @ rng.normal(size=4 * mavs)).reshape(mavs, 4)[:-1]
    bank = bank_at(prior[None])
    bank.P[0] = P
    window = Window(mavs, 40)
    frame = window.add(0, {i: truth[i] if i == 0 else np.zeros(4) for i in range(mavs)})
    labels = []
    for i in range(mavs):
        targets = rng.permutation([j for j in range(mavs) if j != i])[: mavs - 1 - (i < misses)]
        seen = range_and_bearing(relative_pose(np.tile(truth[i], (len(targets), 1)), truth[targets])[:, :3])
        seen[:, 0] += detector.range_sigma_m(seen[:, 0]) * rng.normal(size=len(targets))
        seen[:, 1] += detector.bearing_sigma_rad * rng.normal(size=len(targets)) / np.cos(seen[:, 2])
        seen[:, 2] += detector.bearing_sigma_rad * rng.normal(size=len(targets))
        frame.put(i, seen)
        labels += [(i, int(j), z) for j, z in zip(targets, seen, strict=True)]
    return bank, frame, labels


def predicted(y, i, j):
    return range_and_bearing(relative_pose(y[i], y[j])[:3])


def stacked(y, labels, detector):
    """Residuals, Jacobian (by differences) and noise of all detections, told whose they are; without the station."""
    N = len(y) - 1
    nu, H, R = [], [], []
    for i, j, z in labels:
        h = predicted(y, i, j)
        scale = np.array([1, np.cos(h[2]), 1])
        nu.append(scale * [z[0] - h[0], wrap(z[1] - h[1]), z[2] - h[2]])
        rows = np.zeros((3, N + 1, 4))
        for body in (i, j):
            for k in range(4):
                up, down = y.copy(), y.copy()
                up[body, k] += 1e-6
                down[body, k] -= 1e-6
                change = predicted(up, i, j) - predicted(down, i, j)
                change[1] = wrap(change[1])
                rows[:, body, k] = scale * change / 2e-6
        H.append(rows[:, 1:].reshape(3, -1))
        R += [detector.range_sigma_m(h[0]) ** 2, *[detector.bearing_sigma_rad**2] * 2]
    return np.concatenate(nu), np.vstack(H), np.diag(R)


@pytest.mark.parametrize("misses", [0, 2])
@pytest.mark.parametrize("seed", range(6))
def test_certain_detections_make_a_kalman_update(seed, misses):
    bank, frame, labels = scene(np.random.default_rng([2, seed]), 4, SURE, misses=misses)
    y, P = bank.y[0].copy(), bank.P[0].copy()
    tick = Filter(AgentConfig(detector=SURE), 4, RATE_HZ).update(bank, frame)
    nu, H, R = stacked(y, labels, SURE)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    np.testing.assert_allclose(bank.y[0, 1:].ravel(), y[1:].ravel() + K @ nu, atol=1e-6)
    np.testing.assert_allclose(bank.P[0], P - K @ H @ P, atol=1e-8)
    np.testing.assert_array_equal(bank.y[0, 0], y[0])
    assert tick.events[0] == len(labels)
    assert tick.explained.sum() == pytest.approx(len(labels), abs=1e-3)


@pytest.mark.parametrize("misses", [0, 2])
@pytest.mark.parametrize("seed", range(8))
def test_the_evidence_is_the_marginal_likelihood(seed, misses):
    """Of a case that is as good as linear: N(nu; 0, H P H' + R), with the odds of detections, misses and clutter."""
    detector = Detector(P_D=0.9, range_sigma_slope=0.0, range_sigma_offset_m=0.1, false_per_set=1e-3)
    bank, frame, labels = scene(np.random.default_rng([3, seed]), 4, detector, 0.01, 0.004, misses)
    nu, H, R = stacked(bank.y[0], labels, detector)
    S = H @ bank.P[0] @ H.T + R
    expected = -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])
    expected += sum(np.log(0.9 / (detector.clutter_density * z[0] ** 2)) for _, _, z in labels)
    expected += (4 * 3 - len(labels)) * np.log(0.1)
    tick = Filter(AgentConfig(detector=detector), 4, RATE_HZ).update(bank, frame)
    assert tick.evidence[0] == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("seed", range(6))
def test_one_detection_is_believed_by_its_odds(seed):
    """Of one target, against missed and false: with what the correlated errors of both make of the residual."""
    rng = np.random.default_rng([11, seed])
    detector = Detector(false_per_set=100, P_D=0.1)
    bank, frame, labels = scene(rng, 3, detector, 0.2, 0.05)
    i, j, z = next(label for label in labels if label[0] == 1 and label[1] == 2)
    frame.heard[:], frame.spherical[:] = False, np.nan
    z = z + rng.normal(0, [0.3, 0.05, 0.05])
    frame.put(i, z[None])
    bank.placed[0, 0] = False  # two of them are enough
    nu, H, R = stacked(bank.y[0], [(i, j, z)], detector)
    S = H @ bank.P[0] @ H.T + R
    density = np.exp(-0.5 * nu @ np.linalg.solve(S, nu)) / np.sqrt(np.linalg.det(2 * np.pi * S))
    odds = density / 9 / (detector.clutter_density * z[0] ** 2)
    P_D, found = Filter(AgentConfig(detector=detector), 3, RATE_HZ).explained(bank, frame)
    assert P_D.tolist() == [[0, 0, 0], [0, 0, 0.1], [0, 0, 0]]
    assert found[i, j] == pytest.approx(odds / (1 + odds), abs=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_a_false_detection_earns_nothing(seed):
    evidence = []
    for false in (0, 1):
        bank, frame, _ = scene(np.random.default_rng([4, seed]), 3, Detector())
        if false:
            own = frame.spherical[1][np.isfinite(frame.spherical[1, :, 0])]
            frame.put(1, np.concatenate([own, [[11.0, 0.5, -1.3]]]))
        evidence.append(Filter(AgentConfig(), 3, RATE_HZ).update(bank, frame).evidence[0])
    assert evidence[0] == pytest.approx(evidence[1], abs=1e-9)


def test_many_hypotheses_at_once_are_each_as_if_alone():
    scenes = [scene(np.random.default_rng([5, 0]), 4, Detector()) for _ in range(3)]
    frame = scenes[0][1]
    rng = np.random.default_rng(5)
    banks = []
    for bank, _, _ in scenes:
        bank.y[0, 1:] += rng.normal(0, 0.02, (4, 4))
        banks.append(bank)
    banks[2].placed[0, 3] = False
    sight = Filter(AgentConfig(), 4, RATE_HZ)
    together = banks[0].joined(banks[1]).joined(banks[2])
    many = sight.update(together, frame, 2)
    for k, bank in enumerate(banks):
        one = sight.update(bank, frame, 2)
        assert many.evidence[k] == pytest.approx(one.evidence[0], abs=1e-5)
        np.testing.assert_allclose(together.y[k], bank.y[0], atol=1e-7)
        np.testing.assert_allclose(together.P[k], bank.P[0], atol=1e-7)


def test_who_is_not_placed_is_neither_seen_nor_moved_by_what_is_seen():
    bank, frame, _ = scene(np.random.default_rng(6), 4, Detector())
    bank.placed[0, 2] = False
    bank.P[0] = np.diag(bank.P[0].diagonal())
    y, P = bank.y[0].copy(), bank.P[0].copy()
    tick = Filter(AgentConfig(), 4, RATE_HZ).update(bank, frame)
    np.testing.assert_allclose(bank.y[0, 2], y[2], atol=1e-12)
    np.testing.assert_allclose(bank.P[0, 4:8, 4:8], P[4:8, 4:8], atol=1e-12)
    for pairs in (tick.expected, tick.explained):
        assert not pairs[0, 2].any()
        assert not pairs[0, :, 2].any()


def test_whose_set_was_not_heard_explains_nothing_and_is_not_blamed():
    bank, frame, _ = scene(np.random.default_rng(7), 3, Detector())
    frame.heard[1] = False
    frame.spherical[1] = np.nan
    tick = Filter(AgentConfig(), 3, RATE_HZ).update(bank, frame)
    assert tick.expected[0].astype(bool).tolist() == [[0, 1, 1], [0, 0, 0], [1, 1, 0]]


def test_from_a_wide_prior_it_takes_more_than_one_step():
    off, sharp = [], Detector(range_sigma_slope=0.0, range_sigma_offset_m=0.01, bearing_sigma_rad=0.001)
    for iterations in (1, 4):
        rng = np.random.default_rng(8)
        tick = next(exact(rng, 4, 1))
        truth = true_poses(tick)
        bank = bank_at(truth[None], 0.4, 0.15)
        bank.y[0, 1:4] += rng.normal(0, [0.2, 0.2, 0.2, 0.08], (3, 4))
        Filter(AgentConfig(detector=sharp), 4, RATE_HZ).update(bank, window_of([tick]).frames[0], iterations)
        off.append(np.abs(bank.y[0, :4] - truth).max())
    assert off[1] < 0.1 * off[0]
    assert off[1] < 1e-3


def test_hypotheses_begin_where_they_are_placed_and_are_carried_back():
    rng = np.random.default_rng(9)
    ticks = list(exact(rng, 3, 6))
    window = window_of(ticks)
    odometry, _ = heard(ticks[-1])
    made = begin([placement(true_poses(ticks[-1]))], alone(odometry[0], 3), window.frames[-1], window.frames[0])
    truth = true_poses(ticks[0])
    np.testing.assert_allclose(made.y[0, :3, :3], truth[:, :3], atol=1e-9)
    np.testing.assert_allclose(wrap(made.y[0, :3, 3] - truth[:, 3]), 0, atol=1e-9)
    np.testing.assert_array_equal(made.y[0, 3], 0)
    assert np.linalg.eigvalsh(made.P[0]).min() > 0
