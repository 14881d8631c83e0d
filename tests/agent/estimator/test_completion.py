"""Readings that were lost lie on the chord between those before and after."""

import numpy as np

from agent.estimator.completion import completed


def path(ticks=12, mavs=2):
    t = np.arange(ticks)[:, None, None]
    z = np.array([[0.1, -0.2, 0.3, 0.5]]) * t + np.arange(mavs)[None, :, None] * [1.0, 2, 3, 1]
    z[..., 3] = (z[..., 3] + np.pi) % (2 * np.pi) - np.pi
    return z


def test_with_nothing_lost_nothing_changes():
    z = path()
    found = completed(z, 10)
    np.testing.assert_array_equal(found.z, z)
    assert not found.between.any()
    assert found.z is not z


def test_what_lies_between_two_is_interpolated_also_over_the_wrap():
    z = path()
    lost = z.copy()
    lost[3:6, 0] = lost[8, 1] = np.nan
    found = completed(lost, 10)
    assert np.abs(found.z[..., :3] - z[..., :3]).max() < 1e-12
    assert np.abs((found.z[..., 3] - z[..., 3] + np.pi) % (2 * np.pi) - np.pi).max() < 1e-12
    assert found.between[:, 0].tolist() == [0, 0, 0, 4, 4, 4, 0, 0, 0, 0, 0, 0]
    assert found.between[:, 1].tolist() == [0] * 8 + [2] + [0] * 3


def test_before_the_first_after_the_last_and_too_long_a_gap_stay_open():
    z = path()
    z[:2, 0] = z[10:, 0] = z[2:9, 1] = np.nan
    found = completed(z, 7)
    np.testing.assert_array_equal(found.z, z)
    assert not found.between.any()
    assert (completed(z, 8).between[2:9, 1] == 8).all()
