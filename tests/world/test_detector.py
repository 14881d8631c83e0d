"""Do detections have the stated rate, noise, clutter and field of view, and tell nobody who is who?"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from agent.interface.fleet import Fleet
from agent.interface.frames import direction, range_and_bearing, rotation_matrix
from agent.interface.sensors import Detector
from world.detector import DetectionSet, Detectors
from world.poses import Poses

LEVEL = (0.0, 0.0, 0.0, 1.0)
LOOK_ALONG_X = {"fov_azimuth_rad": 2.0, "fov_elevation_rad": 1.0}


class Scene(NamedTuple):
    true: Poses
    spherical: np.ndarray  # (N, 3) truth seen by MAV 1


def scene(positions: list[list[float]], quaternion: tuple[float, ...] = LEVEL) -> Scene:
    p, q = np.array(positions, float), np.tile(quaternion, (len(positions), 1))
    return Scene(Poses(p, q), range_and_bearing((p - p[0]) @ rotation_matrix(q[0])))


AROUND = scene([[0, 0, 0], [3, 0, 0], [0, 5, 1], [0, 0, 4], [-2, -2, 0], [1, -6, -2]], (0.1, -0.2, 0.3, 0.9273618495))


def sets_of_mav_1(detector: Detector, true: Poses, ticks: int, seed: int = 1) -> list[DetectionSet]:
    detectors = Detectors(detector, Fleet(mavs=len(true.position), seed=seed))
    return [detectors.detect(true)[0] for _ in range(ticks)]


def of_target(sets: list[DetectionSet], mav: int) -> np.ndarray:
    return np.concatenate([each.spherical[each.labels == mav] for each in sets])


@pytest.mark.statistical
@pytest.mark.parametrize("P_D", [0.5, 0.9])
def test_rate_of_detection(P_D: float) -> None:
    sets = sets_of_mav_1(Detector(P_D=P_D), AROUND.true, 1000)
    rates = [len(of_target(sets, mav)) / 1000 for mav in range(2, 7)]
    np.testing.assert_allclose(rates, P_D, atol=4 * np.sqrt(P_D * (1 - P_D) / 1000))
    assert len(of_target(sets, 1)) == 0  # nobody detects itself
    other = Detector(P_D=P_D - 0.1)
    wrong = len(of_target(sets_of_mav_1(other, AROUND.true, 1000), 2)) / 1000
    assert abs(wrong - P_D) > 4 * np.sqrt(P_D * (1 - P_D) / 1000), "a lower rate must fail"


@pytest.mark.statistical
def test_noise_is_isotropic_across_the_line_of_sight_and_grows_along_it() -> None:
    detector = Detector(P_D=0.999)
    sets = sets_of_mav_1(detector, AROUND.true, 1500)
    for mav in range(2, 7):
        distance, azimuth, elevation = AROUND.spherical[mav - 1]
        measured = of_target(sets, mav)
        seen = direction(measured[:, 1], measured[:, 2])
        left = direction(azimuth + np.pi / 2, np.array(0.0))
        up = direction(azimuth, elevation + np.pi / 2)
        for axis in (left, up):
            swing = seen @ axis
            assert swing.std() / detector.bearing_sigma_rad == pytest.approx(1, abs=0.07)
            assert swing.std() / 0.007 != pytest.approx(1, abs=0.07), "another sigma must fail"
            assert abs(swing.mean()) < 0.0008
        assert abs(np.corrcoef(seen @ left, seen @ up)[0, 1]) < 4 / np.sqrt(1500)
        sigma = 0.0495 * distance + 0.0336
        assert (measured[:, 0] - distance).std() / sigma == pytest.approx(1, abs=0.07)
        assert abs((measured[:, 0] - distance).mean()) < 4 * sigma / np.sqrt(1500)


def test_noise_moves_the_direction_as_its_plain_twin_does() -> None:
    """The twin: the line of sight turned about the axis across it that the two numbers give."""
    draw = np.random.default_rng(8)
    true = np.column_stack([draw.uniform(0.5, 9, 40), draw.uniform(-3.1, 3.1, 40), draw.uniform(-1.5, 1.5, 40)])
    true[0, 2], true[1, 2] = np.pi / 2, -np.pi / 2  # straight above and below
    noise = draw.standard_normal((40, 3))
    measured = Detectors(Detector(bearing_sigma_rad=0.3), Fleet())._measure(true, noise)
    for (distance, azimuth, elevation), (a, b, c), seen in zip(true, noise, measured, strict=True):
        sight, up = direction(azimuth, elevation), direction(azimuth, elevation + np.pi / 2)
        turn = Rotation.from_rotvec(0.3 * (a * up - b * np.cross(up, sight)))
        np.testing.assert_allclose(direction(seen[1], seen[2]), turn.apply(sight), atol=1e-12)
        assert seen[0] == pytest.approx(max(distance + (0.0495 * distance + 0.0336) * c, 0.01))
    assert np.abs(measured[:, 1]).max() <= np.pi


def test_ranges_stay_positive() -> None:
    close = scene([[0, 0, 0], [0.02, 0, 0]])
    assert min(of_target(sets_of_mav_1(Detector(), close.true, 300), 2)[:, 0]) == 0.01


@pytest.mark.statistical
@pytest.mark.parametrize("view", [{}, LOOK_ALONG_X])
def test_clutter_is_poisson_and_uniform_in_the_volume_in_view(view: dict[str, float]) -> None:
    detector = Detector(false_per_set=2.0, **view)
    detectors = Detectors(detector, Fleet(mavs=6))
    sets = [each for _ in range(400) for each in detectors.detect(AROUND.true)]
    counts = np.array([(each.labels == 0).sum() for each in sets])
    assert counts.mean() == pytest.approx(2.0, abs=0.12)
    assert counts.var() == pytest.approx(2.0, abs=0.25)  # a fixed number per set would have 0
    false = of_target(sets, 0)
    assert detector.in_view(false).all()
    uniform = np.stack(
        [
            (false[:, 0] / detector.max_range_m) ** 3,
            false[:, 1] / detector.fov_azimuth_rad + 0.5,
            np.sin(false[:, 2]) / np.sin(detector.fov_elevation_rad / 2) / 2 + 0.5,
        ],
        axis=-1,
    )
    limit = 1.95 / np.sqrt(len(false))  # Kolmogorov-Smirnov at 0.1 %
    for column in uniform.T:
        assert distance_from_uniform(column) < limit
    assert distance_from_uniform(false[:, 0] / detector.max_range_m) > limit, "uniform in range must fail"
    np.testing.assert_allclose(np.corrcoef(uniform.T) - np.eye(3), 0, atol=0.05)


def distance_from_uniform(values: np.ndarray) -> float:
    ordered = np.sort(values)
    return float(np.abs(ordered - np.arange(1, len(ordered) + 1) / len(ordered)).max())


@pytest.mark.statistical
def test_order_tells_nothing() -> None:
    sets = sets_of_mav_1(Detector(P_D=0.999, false_per_set=1.0), AROUND.true, 1000)
    for label in (2, 6, 0):
        places = np.concatenate(
            [np.flatnonzero(each.labels == label) / (len(each.labels) - 1) for each in sets if len(each.labels) > 4]
        )
        assert places.mean() == pytest.approx(0.5, abs=0.04)
    assert np.mean([np.searchsorted([2, 3, 4, 5, 6], 6) / 4]) != pytest.approx(0.5, abs=0.04), "sorted must fail"


def test_the_field_of_view_turns_with_the_rolled_and_pitched_body() -> None:
    detector = Detector(P_D=0.999, false_per_set=1e-6, **LOOK_ALONG_X)
    targets = [[0, 0, 0], [5, 0, 0], [5, 5, 0], [-5, 0, 0], [5, 0, 4], [13, 0, 0]]  # ahead, left, behind, above, far
    for quaternion, seen in (
        (LEVEL, {2, 3}),
        ((0, 0, 1, 0), {4}),  # turned about
        ((0, -np.sin(0.4), 0, np.cos(0.4)), {5}),  # nose up by 0.8 rad
        ((np.sqrt(0.5), 0, 0, np.sqrt(0.5)), {2, 5}),  # rolled by 90 deg: wide is now upright
    ):
        sets = sets_of_mav_1(detector, scene(targets, quaternion).true, 20)
        assert {int(label) for each in sets for label in each.labels} == seen


def test_each_mav_has_its_own_stream() -> None:
    """What MAV 1 draws does not depend on what the others see."""
    one = Detectors(Detector(), Fleet(mavs=3, seed=5))
    two = Detectors(Detector(), Fleet(mavs=3, seed=5))
    near = scene([[0, 0, 0], [2, 0, 0], [0, 3, 0]]).true
    for _ in range(20):
        turned = Poses(near.position, np.array([LEVEL, (0, 0, 1, 0), (0, 1, 0, 0)], float))
        a, b = one.detect(near), two.detect(turned)
        assert (a[0].spherical == b[0].spherical).all()
        assert not np.array_equal(a[1].spherical, b[1].spherical)
