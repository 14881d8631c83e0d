"""Which pairs are scored when somebody is cut off, killed or started anew? Cases worked out by hand."""

import numpy as np
import pytest

from agent.interface.messages import LOCALISED, SEARCHING
from deploy.faults import Faults, LinkRule, Partition
from deploy.pairs import first_of_spell, localised_since, pairs_of
from deploy.recording import GONE, UNKNOWN

K, N = 60, 3
TIME_S = np.arange(K) / 10.0
ALL = np.zeros((K, N), np.int64)


def ticks(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last tick of every spell in which it holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def test_without_faults_everybody_is_with_everybody() -> None:
    for faults in (Faults(), Faults(loss=0.5, delay_ms=300)):
        pairs = pairs_of(ALL, faults, TIME_S)
        assert pairs.alive.all()
        assert pairs.again.all()
        assert not pairs.cut_off.any()


def test_a_cut_ends_and_needs_time_to_settle() -> None:
    cut = Partition(groups=((1,), (2, 3)), from_s=1.0, until_s=2.0, one_way=True)
    pairs = pairs_of(ALL, Faults(partitions=(cut,)), TIME_S)
    assert ticks(pairs.cut_off[:, 0, 1]) == ticks(pairs.cut_off[:, 1, 0]) == [(10, 19)]
    assert ticks(pairs.again[:, 0, 2]) == [(0, 9), (39, 59)]
    assert pairs.again[:, 1, 2].all()


def test_a_link_that_loses_all_is_a_cut_and_one_that_loses_one_topic_is_not() -> None:
    rule = LinkRule(senders=(1,), receivers=(2,), from_s=1.0, loss=1.0)
    assert ticks(pairs_of(ALL, Faults(links=(rule,)), TIME_S).cut_off[:, 1, 0]) == [(10, 59)]
    rule = LinkRule(senders=(1,), receivers=(2,), from_s=1.0, loss=1.0, topics=("detections",))
    assert not pairs_of(ALL, Faults(links=(rule,)), TIME_S).cut_off.any()


def lives(mav: int, gone: slice, incarnation: int) -> np.ndarray:
    found = ALL.copy()
    found[gone.stop :, mav - 1] = incarnation
    found[gone, mav - 1] = GONE
    return found


def test_who_is_dead_is_not_scored_and_who_comes_back_settles_first() -> None:
    pairs = pairs_of(lives(2, slice(10, 20), 1), Faults(), TIME_S)
    assert ticks(pairs.alive[:, 0, 1]) == [(0, 9), (20, 59)]
    assert ticks(pairs.again[:, 0, 1]) == ticks(pairs.again[:, 1, 2]) == [(0, 9), (40, 59)]
    assert pairs.again[:, 0, 2].all()
    assert not pairs.cut_off.any()


def test_a_restart_within_one_tick_is_another_life() -> None:
    pairs = pairs_of(lives(2, slice(10, 10), 1), Faults(), TIME_S)
    assert ticks(pairs.again[:, 0, 1]) == [(0, 9), (30, 59)]


def since(states: list[int], incarnations: np.ndarray) -> list[float]:
    """When MAV 1 called MAV 2 localised, tick by tick."""
    all_states = np.full((K, N, N), UNKNOWN, np.uint8)
    all_states[:, 0, 1] = states
    return [float(each) for each in localised_since(all_states, incarnations, TIME_S)[:, 0, 1]]


def test_in_a_first_life_the_first_time_counts() -> None:
    found = since([SEARCHING] * 5 + [LOCALISED] * 5 + [SEARCHING] * 5 + [LOCALISED] * 45, ALL)
    assert np.isnan(found[:5]).all()
    assert set(found[5:]) == {0.5}


def test_in_a_later_life_a_belief_about_the_former_one_does_not_count() -> None:
    again = [LOCALISED] * 22 + [SEARCHING] * 6 + [LOCALISED] * 32
    found = since(again, lives(2, slice(10, 20), 1))
    assert set(found[:10]) == {0.0}
    assert set(found[10:20]) == {1.0}
    assert found[20:22] == [2.0, 2.0]
    assert np.isnan(found[22:28]).all()
    assert found[28:] == pytest.approx([2.8] * 32)
    demoted_later = [LOCALISED] * 45 + [SEARCHING] * 5 + [LOCALISED] * 10
    assert set(since(demoted_later, lives(2, slice(10, 20), 1))[20:]) == {2.0}


def test_when_a_spell_began() -> None:
    holds = np.zeros((6, 1, 1), bool)
    holds[[1, 2, 5]] = True
    assert first_of_spell(holds)[:, 0, 0].tolist() == [0, 1, 1, 3, 4, 5]
