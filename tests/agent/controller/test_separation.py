"""Who comes too near is pushed away, and nobody else."""

import numpy as np
import pytest

from agent.controller.separation import KEEP_M, MOST_M, SIGMAS, push


def test_far_enough_there_is_no_push():
    assert not push(np.zeros(3), np.array([[KEEP_M + 0.1, 0, 0], [0, 2, 0]]), np.array([0.04, 0.0])).any()
    assert not push(np.zeros(3), np.zeros((0, 3)), np.zeros(0)).any()


@pytest.mark.parametrize("sigma", [0.0, 0.05])
def test_the_nearer_the_stronger_and_away(sigma):
    near = [push(np.zeros(3), np.array([[x, 0, 0]]), np.array([sigma])) for x in (0.7, 0.6, 0.5)]
    assert [each[0] for each in near] == pytest.approx([-(KEEP_M + SIGMAS * sigma - x) for x in (0.7, 0.6, 0.5)])
    assert not np.array(near)[:, 1:].any()


def test_a_push_is_bounded_even_from_the_same_place():
    found = push(np.zeros(3), np.array([[0.01, 0, 0], [0, 0.01, 0], [0.0, 0, 0]]), np.full(3, 0.5))
    assert np.isfinite(found).all()
    assert np.linalg.norm(found) <= MOST_M + 1e-9
