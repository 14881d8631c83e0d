"""Is who is silent still to be seen? By what is detected, and by what is not."""

import numpy as np
import pytest

from agent.estimator import visibility
from agent.estimator.innovations import Innovations
from agent.estimator.state import Poses
from agent.estimator.station_update import Pairs
from agent.interface.frames import range_and_bearing
from agent.interface.sensors import Detector

DETECTOR = Detector()
PLACES = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [4, 4, 0]], float)  # of three MAVs, and one who is silent
SILENT, SIGMA_M = 3, 1.0


def team(places=PLACES, sigma_m=SIGMA_M):
    """With the start as the last body."""
    y = np.zeros((len(places) + 1, 4))
    y[:-1, :3] = places
    variance = np.full((len(y), 4), 1e-4)
    variance[SILENT, :3] = sigma_m**2
    return Poses(y.ravel(), np.diag(variance.ravel()))


def looked_for(seen, before=0.5, poses=None):
    """The probability that he is in view, when these stations (body: places seen, (M, 3)) have looked."""
    poses = poses or team()
    sets = [range_and_bearing(np.reshape(places, (-1, 3)) - PLACES[station]) for station, places in seen.items()]
    pairs = Pairs.at(poses, DETECTOR)
    stations = list(seen)
    found = Innovations.of(poses, pairs, stations, sets)
    in_view = np.ones(len(pairs.P_D))
    in_view[SILENT] = before
    after = visibility.looked_for(in_view, pairs, stations, found, DETECTOR.clutter_density)
    assert (np.delete(after, SILENT) == 1).all()
    return after[SILENT]


def test_whoever_is_heard_is_in_view_and_who_is_silent_may_go_or_come_back():
    before = np.array([1.0, 0.0, 1.0])
    assert visibility.later(before, np.array([False, False, False]), 0.1).tolist() == [1, 1, 1]
    after = visibility.later(before, np.array([False, True, True]), 0.1)
    assert after == pytest.approx([1, 1e-4, 1 - 1e-4])
    assert visibility.later(before, np.array([True] * 3), 1e6).max() <= 1


@pytest.mark.parametrize("stations", [0, 1, 3])
def test_every_set_without_him_makes_it_less_likely(stations):
    odds = (1 - DETECTOR.P_D) ** stations
    assert looked_for({station: [] for station in range(stations)}) == pytest.approx(odds / (1 + odds))


def test_who_is_out_of_range_is_not_missed():
    away = PLACES.copy()
    away[SILENT, 0] = 50.0
    assert looked_for({0: [], 1: []}, poses=team(away)) == pytest.approx(0.5)


def test_a_detection_where_he_may_be_shows_him():
    assert looked_for({0: [PLACES[SILENT] + 0.5]}, before=0.01) > 0.8


def test_a_detection_far_from_where_he_may_be_does_not():
    assert looked_for({0: [PLACES[SILENT] + 4.0]}) == pytest.approx(looked_for({0: []}), rel=0.01)


def test_a_detection_of_another_near_him_does_not():
    poses = team(np.vstack([PLACES[:3], PLACES[1] + [0.5, 0.5, 0]]))
    assert looked_for({0: [PLACES[1]]}, poses=poses) < 0.15


def test_the_larger_the_region_he_may_be_in_the_less_one_detection_shows():
    near = [looked_for({0: [PLACES[SILENT]]}, 1e-3, team(sigma_m=sigma_m)) for sigma_m in (0.3, 1.0, 3.0)]
    assert near == sorted(near, reverse=True)
