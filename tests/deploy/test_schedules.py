"""Whatever goes wrong: no exception, no negative eigenvalue, no wrong commit, no queue without a bound.

A few schedules; `make schedules` flies a thousand.
"""

import numpy as np
import pytest

from deploy import commits
from deploy.experiment import load
from tests import schedules


@pytest.mark.parametrize("seed", range(6))
def test_a_random_schedule_breaks_nothing(seed: int) -> None:
    schedules.fly(schedules.drawn(seed))


def test_the_same_seed_draws_the_same_schedule() -> None:
    assert schedules.drawn(5) == schedules.drawn(5) != schedules.drawn(6)


@pytest.mark.parametrize(
    ("row", "column", "value", "why"),
    [(1, 1, -1e-3, "negative"), (0, 1, 0.1, "symmetric"), (2, 2, np.inf, "finite"), (0, 0, np.nan, "finite")],
)
def test_a_covariance_that_is_none_is_noticed(row: int, column: int, value: float, why: str) -> None:
    Sigma = np.eye(3)
    schedules.expect_covariance(Sigma)
    Sigma[row, column] = value
    with pytest.raises(schedules.Broken, match=why):
        schedules.expect_covariance(Sigma)


def test_wrong_commits_are_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commits, "WRONG_M", 1e-6)
    with pytest.raises(schedules.Broken, match="wrong commits by MAV"):
        schedules.fly(load("cold_start", ["fleet.mavs=3", "fleet.duration_s=2"], seed=0))
