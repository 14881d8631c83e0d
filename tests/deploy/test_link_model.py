"""What becomes of packets on one link, case by case and on average?"""

from typing import Any

import numpy as np
import pytest

from agent.interface.fleet import Fleet
from deploy.faults import Conditions, Faults, LinkRule, Partition
from deploy.link_model import LinkModel, is_cut

FLEET = Fleet(mavs=3, seed=4)
SIZE = 100  # bytes
MS = 10**6


def link(faults: Faults, sender: int = 1, receiver: int = 2, seed: int = 4, **more: int) -> LinkModel:
    return LinkModel(faults, Fleet(mavs=3, seed=seed), sender, receiver, **more)


def arrivals(faults: Faults, packets: int = 50, topic: str = "odometry", period_ms: int = 100, **which: Any) -> list:
    model = link(faults, **which)
    return [model.arrivals_ns(k * period_ms * MS, topic, SIZE) for k in range(packets)]


def delays_ms(found: list, period_ms: int = 100) -> np.ndarray:
    return np.array([(first - k * period_ms * MS) / MS for k, (first, *_) in enumerate(found)])


def test_a_link_without_faults_is_punctual() -> None:
    assert arrivals(Faults()) == [(k * 100 * MS,) for k in range(50)]


def test_a_fixed_delay() -> None:
    assert set(delays_ms(arrivals(Faults(delay_ms=250)))) == {250.0}


def test_all_or_nothing_is_lost() -> None:
    assert not any(arrivals(Faults(loss=1.0)))
    assert not any(arrivals(Faults(burst_loss=1.0)))
    assert all(arrivals(Faults(loss=0.0, delay_ms=1)))


def test_only_the_topics_and_links_and_times_that_are_meant() -> None:
    faults = Faults(
        links=(LinkRule(senders=(1,), receivers=(2,), from_s=1.0, until_s=2.0, loss=1.0, topics=("odometry",)),)
    )
    lost = [k for k, arrives in enumerate(arrivals(faults)) if not arrives]
    assert lost == list(range(10, 20))
    assert all(arrivals(faults, topic="detections"))
    assert all(arrivals(faults, sender=2, receiver=1))
    assert all(arrivals(faults, sender=3))


def test_rules_add_up() -> None:
    faults = Faults(delay_ms=100, links=(LinkRule(from_s=1.0, delay_ms=50), LinkRule(from_s=2.0, loss=1.0)))
    found = arrivals(faults)
    assert delays_ms(found[:20]).tolist() == [100.0] * 10 + [150.0] * 10
    assert not any(found[20:])


def test_a_partition_cuts_and_heals() -> None:
    cut = Partition(groups=((1,), (2,)), from_s=1.0, until_s=2.0)
    lost = [k for k, arrives in enumerate(arrivals(Faults(partitions=(cut,)))) if not arrives]
    assert lost == list(range(10, 20))
    assert all(arrivals(Faults(partitions=(cut,)), sender=3))


def test_what_a_partition_has_kept_arrives_when_it_heals() -> None:
    cut = Partition(groups=((1,), (2,)), from_s=1.0, until_s=2.0, kept=True)
    found = arrivals(Faults(partitions=(cut,), delay_ms=50))
    assert found[10:20] == [(2000 * MS,)] * 9 + [(2000 * MS,)]
    assert found[20] == (2050 * MS,)


def test_a_narrow_link_makes_a_queue_and_drops_what_would_wait_too_long() -> None:
    """100 bytes each 100 ms over 500 bytes/s: every packet takes 200 ms, so the queue grows by 100 ms each time."""
    found = arrivals(Faults(bandwidth_bytes_s=500.0))
    assert delays_ms(found[:11]).tolist() == pytest.approx([200.0 + 100 * k for k in range(11)])
    assert 0.4 < np.mean([not arrives for arrives in found[11:]]) < 0.6
    assert max(first for first, *_ in filter(None, found)) <= (49 * 100 + 1000 + 200 + 1) * MS
    assert set(delays_ms(arrivals(Faults(bandwidth_bytes_s=1e4)))) == {10.0}


def test_duplicates_have_jitter_of_their_own() -> None:
    assert {len(arrives) for arrives in arrivals(Faults(duplicates=1.0))} == {2}
    found = arrivals(Faults(duplicates=1.0, delay_ms=100, jitter_ms=50))
    assert all(first < second for first, second in found)


def test_nothing_arrives_before_it_was_sent() -> None:
    assert min(delays_ms(arrivals(Faults(jitter_ms=80)))) == 0.0


def test_what_is_held_back_is_overtaken() -> None:
    found = arrivals(Faults(reorder=0.3))
    held = [k for k, delay in enumerate(delays_ms(found)) if delay]
    assert 5 < len(held) < 25
    assert all(100 <= delay <= 200 for delay in delays_ms(found)[held])
    firsts = [first for first, *_ in found]
    assert firsts != sorted(firsts)


NOISY = Faults(loss=0.2, burst_loss=0.2, jitter_ms=30, delay_ms=60, duplicates=0.1, reorder=0.1)


def test_the_same_seed_gives_the_same_and_another_seed_another_fate() -> None:
    assert arrivals(NOISY) == arrivals(NOISY)
    assert arrivals(NOISY) != arrivals(NOISY, seed=5)
    assert arrivals(NOISY) != arrivals(NOISY, sender=3)
    assert arrivals(NOISY) != arrivals(NOISY, sender=2, receiver=1)
    assert arrivals(NOISY) != arrivals(NOISY, incarnation=1)


def test_what_one_link_does_depends_on_no_other() -> None:
    alone, one, other = link(NOISY), link(NOISY), link(NOISY, sender=3)
    for k in range(50):
        other.arrivals_ns(k * 100 * MS, "odometry", SIZE)
        expected = alone.arrivals_ns(k * 100 * MS, "odometry", SIZE)
        assert one.arrivals_ns(k * 100 * MS, "odometry", SIZE) == expected


def test_who_survives_more_loss_survives_less_with_the_same_delay() -> None:
    """So a study over the loss compares like with like."""
    some, most = (arrivals(Faults(loss=loss, jitter_ms=30, delay_ms=60), 200) for loss in (0.1, 0.5))
    assert all(less == more for less, more in zip(some, most, strict=True) if more)
    assert sum(map(bool, some)) > sum(map(bool, most))


PACKETS = 20_000


def share_lost(faults: Faults, seed: int = 4) -> float:
    return float(np.mean([not arrives for arrives in arrivals(faults, PACKETS, seed=seed)]))


@pytest.mark.statistical
def test_the_share_that_is_lost() -> None:
    """Four standard deviations of a binomial share; another share is outside."""
    for loss in (0.1, 0.5):
        band = 4 * np.sqrt(loss * (1 - loss) / PACKETS)
        assert abs(share_lost(Faults(loss=loss)) - loss) < band
        assert abs(share_lost(Faults(loss=loss * 1.1)) - loss) > band
    two = Faults(loss=0.3, links=(LinkRule(loss=0.5),))
    assert abs(share_lost(two) - 0.65) < 4 * np.sqrt(0.65 * 0.35 / PACKETS)


def bursts(lost: np.ndarray) -> np.ndarray:
    """Lengths of the runs of lost packets."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]])))
    return edges[1::2] - edges[::2]


@pytest.mark.statistical
def test_bursts_have_the_mean_share_and_length() -> None:
    """At 10 ms a packet, so that few bursts fall between two; independent losses come in no bursts."""
    faults = Faults(burst_loss=0.5, burst_s=1.0)
    lost = np.array([not arrives for arrives in arrivals(faults, 200_000, period_ms=10)])
    assert lost.mean() == pytest.approx(0.5, abs=0.06)  # some 1000 bursts: 4 sigmas are about 0.063
    assert bursts(lost).mean() * 0.01 == pytest.approx(1.0, rel=0.13)
    singly = np.array([not arrives for arrives in arrivals(Faults(loss=0.5), 20_000, period_ms=10)])
    assert bursts(singly).mean() * 0.01 < 0.1


@pytest.mark.statistical
def test_jitter_is_distributed_as_it_says() -> None:
    uniform = delays_ms(arrivals(Faults(delay_ms=200, jitter_ms=50), PACKETS))
    assert (uniform >= 150).all()
    assert (uniform <= 250).all()
    assert uniform.mean() == pytest.approx(200, abs=4 * 50 / np.sqrt(3 * PACKETS))
    assert uniform.std() == pytest.approx(50 / np.sqrt(3), rel=0.03)
    skewed = delays_ms(arrivals(Faults(delay_ms=200, jitter_ms=50, jitter="lognormal"), PACKETS)) - 200
    assert skewed.min() > 0
    assert skewed.mean() == pytest.approx(50, rel=4 * np.sqrt((np.e - 1) / PACKETS))
    assert np.log(skewed).std() == pytest.approx(1.0, rel=0.03)
    assert np.log(uniform).std() < 0.5  # the test can tell them apart


@pytest.mark.statistical
def test_shares_of_duplicates_and_of_held_back() -> None:
    found = arrivals(Faults(duplicates=0.1, reorder=0.2), PACKETS)
    assert np.mean([len(arrives) == 2 for arrives in found]) == pytest.approx(0.1, abs=0.009)
    held = np.mean([max(arrives) > k * 100 * MS for k, arrives in enumerate(found)])
    assert held == pytest.approx(0.2 + 0.1 * 0.8 * 0.2, abs=0.012)


@pytest.mark.statistical
def test_topics_of_a_tick_are_lost_each_for_itself_but_not_in_bursts() -> None:
    for faults, together in ((Faults(loss=0.5), 0.25), (Faults(burst_loss=0.5), 0.5)):
        model = link(faults)
        both = [
            not model.arrivals_ns(k * 100 * MS, "odometry", SIZE)
            and not model.arrivals_ns(k * 100 * MS, "detections", 9)
            for k in range(4000)
        ]
        assert np.mean(both) == pytest.approx(together, abs=0.03 if together == 0.25 else 0.12)


def test_when_two_are_cut_off_from_each_other() -> None:
    faults = Faults(
        partitions=(Partition(groups=((1,), (2,)), from_s=1.0, until_s=2.0, one_way=True),),
        links=(
            LinkRule(senders=(3,), from_s=3.0, loss=1.0, topics=("odometry",)),
            LinkRule(senders=(3,), from_s=4.0, burst_loss=1.0, topics=("detections",)),
        ),
    )
    assert [is_cut(faults, 1, 2, time_s) for time_s in (0.9, 1.0, 1.9, 2.0)] == [False, True, True, False]
    assert not is_cut(faults, 2, 1, 1.5)
    assert [is_cut(faults, 3, 1, time_s) for time_s in (2.0, 3.5, 4.0)] == [False, False, True]
    assert not is_cut(faults, 1, 3, 5.0)
    assert not is_cut(Faults(loss=0.99), 1, 2, 0.0)
    assert is_cut(Faults(loss=1.0), 1, 2, 0.0)


def test_conditions_say_whether_they_disturb() -> None:
    assert not Conditions(burst_s=3.0, jitter="lognormal", topics=("odometry",)).disturbs
    assert Conditions(bandwidth_bytes_s=10.0).disturbs
    assert Conditions(reorder=0.1).disturbs
