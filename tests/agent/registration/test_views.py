"""What every station should see of every target, against differences and plain formulas."""

from math import log

import numpy as np
import pytest

from agent.interface.frames import direction, range_and_bearing, wrap
from agent.interface.sensors import Detector
from agent.registration import views

PRECISE = 1e-3  # nats: it works in single precision
DETECTOR = Detector()
AHEAD_ONLY = Detector(fov_azimuth_rad=np.pi / 2, fov_elevation_rad=np.pi / 3)


def nu(target, station, spherical):
    """Residual of a detection of what is at `target`, for who predicted `spherical`; common axes."""
    seen = range_and_bearing(target - station)
    off = seen - spherical
    return np.array([off[0], np.cos(spherical[2]) * wrap(off[1]), off[2]])


@pytest.mark.parametrize("seed", range(20))
def test_axes_are_the_derivative_of_the_residual(seed):
    rng = np.random.default_rng([1, seed])
    station, target = rng.normal(size=3) * 3, rng.normal(size=3) * 3
    spherical = views.predicted(station, target)
    step = 1e-5 * np.eye(3)
    columns = [nu(target + e, station, spherical) - nu(target - e, station, spherical) for e in step]
    np.testing.assert_allclose(views.axes(spherical), np.transpose(columns) / 2e-5, atol=1e-6)


def test_axes_of_many_pairs_are_each_as_if_alone():
    rng = np.random.default_rng(2)
    spherical = range_and_bearing(rng.normal(size=(2, 3, 3)) * 3)
    every = views.axes(spherical)
    assert every.shape == (2, 3, 3, 3)
    np.testing.assert_array_equal(every[1, 2], views.axes(spherical[1, 2]))


def test_axes_stay_finite_where_two_are_in_one_place():
    assert np.isfinite(views.axes(views.predicted(np.ones(3), np.ones(3)))).all()


def test_residuals_wrap_however_often_the_yaws_have_turned():
    spherical = np.array([2.0, 3.1, 0.4])
    for turns in range(-3, 4):
        yaw, detection = 1.5 + 2 * np.pi * turns, np.array([[2.1, -3.1 - 1.5, 0.45]])
        found = views.residuals(spherical, np.array(yaw), detection)
        across = np.cos(0.4) * (2 * np.pi - 6.2)
        np.testing.assert_allclose(np.ravel(found), [0.1, across, 0.05], atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_perfect_detection_leaves_nothing(seed):
    rng = np.random.default_rng([3, seed])
    spherical, yaw = range_and_bearing(rng.normal(size=3)), rng.uniform(-9, 9)
    detection = spherical - [0, yaw, 0]
    assert np.abs(views.residuals(spherical, np.array(yaw), detection[None])).max() < 1e-12


def directly(detector, spherical, yaw, variances, detections):
    """log(1 - P_D + P_D sum_m N(nu_m) / kappa), term by term."""
    total = 1 - detector.P_D
    for r, azimuth, elevation in detections:
        off = np.array(
            [r - spherical[0], np.cos(spherical[2]) * wrap(azimuth + yaw - spherical[1]), elevation - spherical[2]]
        )
        density = np.prod(np.exp(-0.5 * off**2 / variances) / np.sqrt(2 * np.pi * variances))
        volume = 4 / 3 * np.pi * detector.max_range_m**3
        total += detector.P_D * density / (detector.false_per_set / volume * r**2)
    return log(total)


@pytest.mark.parametrize("seed", range(10))
def test_log_seen_is_its_formula(seed):
    rng = np.random.default_rng([4, seed])
    spherical, yaw = range_and_bearing(rng.normal(size=3) * 2 + [2, 0, 0]), rng.uniform(-9, 9)
    variances = views.noise(DETECTOR, spherical[0]) * rng.uniform(1, 4, 3)
    near = spherical - [0, yaw, 0] + rng.normal(size=(3, 3)) * np.sqrt(variances) * 1.5
    found = views.log_seen(DETECTOR, spherical, np.array(yaw), variances, near)
    assert found == pytest.approx(directly(DETECTOR, spherical, yaw, variances, near), abs=PRECISE)


def test_far_detections_and_empty_sets_are_misses():
    spherical, variances = np.array([3.0, 0.2, 0.1]), np.array([0.03, 1e-4, 1e-4])
    for detections in (np.zeros((0, 3)), np.array([[3.0, 1.0, 0.1], [8.0, 0.2, 0.1]])):
        found = views.log_seen(DETECTOR, spherical, np.zeros(()), variances, detections)
        assert found == pytest.approx(log(1 - DETECTOR.P_D))


def test_where_there_is_no_detection_none_is_counted():
    rng = np.random.default_rng(5)
    spherical, variances = np.array([3.0, 0.2, 0.1]), np.array([0.03, 1e-4, 1e-4])
    some = spherical + rng.normal(size=(2, 3)) * np.sqrt(variances)
    padded = np.concatenate([some, np.full((3, 3), np.nan)])
    one, other = (views.log_seen(DETECTOR, spherical, np.zeros(()), variances, z) for z in (some, padded))
    assert one == pytest.approx(other, abs=PRECISE)
    assert np.isfinite(one)


def test_many_pairs_at_once_are_each_as_if_alone():
    rng = np.random.default_rng(6)
    spherical, yaw = range_and_bearing(rng.normal(size=(4, 5, 3)) * 3), rng.uniform(-3, 3, (4, 5))
    variances = views.noise(DETECTOR, spherical[..., 0])
    sets = spherical[:, :3] - np.stack([0 * yaw, yaw, 0 * yaw], axis=-1)[:, :1] + rng.normal(0, 0.01, (4, 3, 3))
    every = views.log_seen(DETECTOR, spherical, yaw, variances, sets[:, None])
    for i, j in np.ndindex(4, 5):
        alone = views.log_seen(DETECTOR, spherical[i, j], yaw[i, j], variances[i, j], sets[i])
        assert every[i, j] == pytest.approx(alone, abs=PRECISE)


@pytest.mark.parametrize(
    ("spherical", "yaw", "seen"),
    [
        ([3.0, 0.0, 0.0], 0.0, True),
        ([3.0, 0.7, 0.0], 0.0, True),
        ([3.0, 0.9, 0.0], 0.0, False),
        ([3.0, 0.9, 0.0], 0.5, True),
        ([3.0, 3.1, 0.0], -3.1, True),
        ([3.0, 0.0, 0.6], 0.0, False),
        ([13.0, 0.0, 0.0], 0.0, False),
    ],
)
def test_what_is_out_of_view_cannot_be_seen(spherical, yaw, seen):
    spherical, yaw = np.array(spherical), np.array(yaw)
    assert views.detection_probability(AHEAD_ONLY, spherical, yaw) == (AHEAD_ONLY.P_D if seen else 0)
    agreement = views.log_seen(AHEAD_ONLY, spherical, yaw, np.full(3, 0.01), np.zeros((0, 3)))
    assert agreement == pytest.approx(log(1 - AHEAD_ONLY.P_D) if seen else 0.0)


def test_a_camera_that_looks_all_around_sees_whatever_is_near_enough():
    spherical = range_and_bearing(direction(np.linspace(-3, 3, 9), np.linspace(-1.5, 1.5, 9)) * 11.9)
    assert (views.detection_probability(DETECTOR, spherical, np.zeros(9)) == DETECTOR.P_D).all()
    assert views.detection_probability(DETECTOR, spherical[0] * [1.1, 1, 1], np.zeros(())) == 0


@pytest.mark.statistical
def test_false_detections_are_as_dense_as_is_said():
    """Uniform in the ball: r grows like a cube root, so its density in (r, azimuth cos el, elevation) like r^2."""
    rng = np.random.default_rng(7)
    n = 400_000
    r = DETECTOR.max_range_m * rng.random(n) ** (1 / 3)
    elevation, azimuth = np.arcsin(rng.uniform(-1, 1, n)), rng.uniform(-np.pi, np.pi, n)
    for at in (3.0, 8.0):
        inside = (np.abs(r - at) < 0.25) & (np.abs(elevation - 0.3) < 0.2) & (np.abs(azimuth * np.cos(0.3)) < 0.4)
        volume = 0.5 * 0.4 * 0.8
        sampled = inside.mean() * DETECTOR.false_per_set / volume
        assert sampled == pytest.approx(views.clutter(DETECTOR, np.array(at)), rel=0.06)
