"""Is it found when MAVs were called localised, and how good that was, in cases that are worked out by hand?"""

import numpy as np
import pytest

from agent.interface.messages import AMBIGUOUS, LOCALISED, SEARCHING
from deploy import commits
from deploy.commits import LeastKnown
from deploy.metrics import Errors
from deploy.recording import UNKNOWN

K, N = 40, 3
TIME_S = np.arange(K) / 10.0


def all_localised() -> np.ndarray:
    return np.full((K, N, N), LOCALISED, np.uint8)


def nobody_localised() -> np.ndarray:
    states = np.full((K, N, N), SEARCHING, np.uint8)
    states[:, range(N), range(N)] = LOCALISED
    return states


def of_pairs(value: float) -> np.ndarray:
    """(K, N, N) as `metrics` gives errors and NEES: none of a MAV about itself."""
    values = np.full((K, N, N), value)
    values[:, range(N), range(N)] = np.nan
    return values


def no_errors() -> Errors:
    return Errors(of_pairs(0.0), of_pairs(0.0))


def test_wrong_commits_count_mavs_called_localised_beyond_the_limits() -> None:
    states, error = all_localised(), no_errors()
    states[10:, 2] = UNKNOWN
    states[5, 1, 0] = AMBIGUOUS
    error.position_m[5:7, 0, 1] = 0.51  # the same MAV twice
    error.yaw_rad[5, 0, 2] = np.deg2rad(10.1)
    error.position_m[6, 1, 2] = 0.49
    error.position_m[5, 1, 0] = 7.0  # it did not call it localised
    error.position_m[20, 2, 1] = 9.0  # nor did this one, which said nothing
    assert commits.wrong_commits(error, states).tolist() == [2, 0, 0]


def test_when_and_whether_all_are_localised() -> None:
    states = all_localised()
    states[:4, 0, 1] = SEARCHING
    states[:6, 0, 2] = SEARCHING
    states[:, 2, 0] = AMBIGUOUS
    states[20:, 1] = UNKNOWN
    at_s = commits.all_localised_at(states, TIME_S)
    assert at_s[:2].tolist() == [0.6, 0.0]
    assert np.isnan(at_s[2])
    assert np.isnan(commits.all_localised_at(states[:0], TIME_S[:0])).all()


def test_the_least_known_mav_is_that_of_the_last_estimate() -> None:
    states = all_localised()
    states[:8, 0, 1] = SEARCHING
    states[-1, 1, [0, 2]] = AMBIGUOUS, SEARCHING
    states[20:, 1] = UNKNOWN  # its last words were that all is well
    states[-1, 2, :2] = AMBIGUOUS
    found = [commits.least_known_at_last(states, agent) for agent in range(N)]
    assert found == [LeastKnown(LOCALISED, None), LeastKnown(LOCALISED, None), LeastKnown(AMBIGUOUS, 0)]
    assert commits.least_known_at_last(states[20:], 1) == LeastKnown(SEARCHING, None)  # never spoke
    assert commits.least_known(bytes([1, 0, 2, 0]), 2) == LeastKnown(SEARCHING, 1)
    assert commits.least_known(bytes([2]), 0) == LeastKnown(LOCALISED, None)  # alone


def test_estimates_are_looked_at_when_they_begin_and_a_second_later() -> None:
    """Agent 0 calls MAV 1 localised at 0.5 s and MAV 2 at 1.2 s, agent 1 MAV 2 too late to be looked at again."""
    states, error = nobody_localised(), no_errors()
    nees = of_pairs(99.0)  # counts only where a pair begins
    for i, j, k, value in ((0, 1, 5, 4.0), (0, 2, 12, 8.0), (1, 2, 35, 12.0)):
        states[k : k + 3, i, j] = LOCALISED  # and then no more: it counts all the same
        nees[k, i, j] = value
    error.position_m[15, 0, 1], error.yaw_rad[15, 0, 1] = 0.2, 0.01
    error.position_m[22, 0, 2], error.yaw_rad[22, 0, 2] = 0.4, 0.03
    found = commits.at_commit(states, nees, error, TIME_S)
    assert found.commit_nees == pytest.approx((4 + 8 + 12) / 4 / 3)
    assert (found.position_1s_m, found.yaw_1s_rad) == pytest.approx((0.3, 0.02))
    assert (found.position_1s_p95_m, found.yaw_1s_p95_rad) == pytest.approx((0.39, 0.029))


def test_what_was_lost_does_not_count_and_without_any_pair_nothing_is_known() -> None:
    states, error, nees = nobody_localised(), no_errors(), of_pairs(4.0)
    states[3:, 0, 1] = states[3:, 0, 2] = LOCALISED
    error.position_m[13, 0, 1], error.yaw_rad[13, 0, 1] = np.nan, np.nan
    error.position_m[13, 0, 2] = 0.1
    nees[3, 0, 1] = np.nan
    found = commits.at_commit(states, nees, error, TIME_S)
    assert found == pytest.approx((1.0, 0.1, 0.0, 0.1, 0.0))
    for ticks in (0, 3):  # of nothing, and of a run in which nobody was localised
        found = commits.at_commit(states[:ticks], nees[:ticks], Errors(*(e[:ticks] for e in error)), TIME_S[:ticks])
        assert np.isnan(found).all()


def test_a_second_at_any_rate() -> None:
    """At 0.5 Hz the first estimate that is at least a second later is the next one."""
    states, error = all_localised(), no_errors()
    error.position_m[1] = 0.7
    found = commits.at_commit(states, of_pairs(4.0), error, np.arange(K) * 2.0)
    assert found.position_1s_m == 0.7
