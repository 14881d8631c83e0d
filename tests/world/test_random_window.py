"""Do recorded flights begin anywhere in their usable part, independently, but not too close to each other?"""

from pathlib import Path

import numpy as np
import pytest

from agent.interface.fleet import Fleet
from agent.interface.tables import BadExperiment
from world.recorded import Flight, RecordedFlights

EUROC = Path(__file__).parents[3] / "shared" / "datasets" / "euroc_vio"


def write(path: Path, time_s: np.ndarray, y_m: float = 0.0) -> None:
    """A level flight along x at 1 m/s, so places say what time it was."""
    path.write_text("".join(f"{t:.3f} {t:.3f} {y_m} 1 0 0 0 1\n" for t in time_s))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Flights of 10 s at 10 Hz on two parallel ways, 5 m apart; the first one's odometry has a gap from 7 to 7.6 s."""
    time_s = np.arange(0.0, 10.001, 0.1)
    for name, y_m in (("a", 0.0), ("b", 5.0)):
        write(tmp_path / f"{name}.txt", time_s, y_m)
    write(tmp_path / "gap.txt", time_s[(time_s < 7.01) | (time_s > 7.59)])
    return tmp_path


def starts(folder: Path, flights: tuple[Flight, ...], seed: int, duration_s: float = 2.0) -> np.ndarray:
    """(N,) s: when the flights begin; after a check that they are played to the end."""
    fleet = Fleet(mavs=len(flights), seed=seed, duration_s=duration_s)
    flight = RecordedFlights(flights, str(folder), fleet, random_window=True)
    began = flight.true.position[:, 0].copy()
    for _ in range(fleet.ticks - 1):
        flight.step()
    np.testing.assert_allclose(flight.true.position[:, 0], began + duration_s - 0.1, atol=1e-9)
    np.testing.assert_allclose(flight.vio.position[:, 0], flight.true.position[:, 0], atol=1e-9)
    return began


def test_windows_cover_the_usable_part_independently(folder: Path) -> None:
    flights = (Flight("a.txt", "a.txt"), Flight("b.txt", "b.txt", from_s=3.0))
    began = np.array([starts(folder, flights, seed) for seed in range(40)])
    last = 10 - 1.9  # the last tick is 1.9 s after the first
    for column, first in zip(began.T, (0.0, 3.0), strict=True):
        assert first - 1e-9 <= column.min() < first + 0.1 * (last - first)
        assert last - 0.1 * (last - first) < column.max() <= last + 1e-9
        assert column.mean() == pytest.approx((first + last) / 2, abs=4 * (last - first) / np.sqrt(12 * 40))
    assert abs(np.corrcoef(began.T)[0, 1]) < 0.5
    assert np.array_equal(began[7], starts(folder, flights, 7))


def test_no_window_holds_a_long_gap(folder: Path) -> None:
    began = np.array([starts(folder, (Flight("a.txt", "gap.txt"),), seed)[0] for seed in range(40)])
    assert ((began <= 7.0 - 1.9 + 1e-9) | (began > 7.6)).all()
    assert began.min() < 1 < 7.6 < began.max()


def test_mavs_do_not_begin_too_close(folder: Path) -> None:
    flights = (Flight("a.txt", "a.txt", from_s=6.0),) * 3
    for seed in range(10):
        assert np.diff(np.sort(starts(folder, flights, seed))).min() >= 0.6 - 1e-9


def test_without_random_windows_flights_begin_at_from_s(folder: Path) -> None:
    for seed in (1, 2):
        flight = RecordedFlights(
            (Flight("a.txt", "a.txt", 3.0),), str(folder), Fleet(mavs=1, seed=seed, duration_s=2.0)
        )
        np.testing.assert_allclose(flight.true.position, [[3, 0, 1]])


def test_impossible_windows(folder: Path) -> None:
    with pytest.raises(BadExperiment, match=r"\[0\]: 1.9 s from from_s = 9 on are asked for, but .* 10.0 s in common"):
        starts(folder, (Flight("a.txt", "a.txt", from_s=9.0),), 0)
    with pytest.raises(
        BadExperiment, match=r"\[0\]: nowhere are there 7.9 s without a gap of more than 0.5 s, expected"
    ):
        starts(folder, (Flight("a.txt", "gap.txt"),), 0, duration_s=8.0)
    with pytest.raises(
        BadExperiment,
        match=r"world.random_window = true: some MAVs are always closer than 0.6 m at the start, expected",
    ):
        starts(folder, (Flight("a.txt", "a.txt", from_s=8.0),) * 2, 0)


@pytest.mark.skipif(not EUROC.is_dir(), reason="the EuRoC recordings are not here")
def test_real_flights_begin_apart() -> None:
    names = (("V2_01", 34.0), ("V2_02", 48.0), ("V2_03", 4.0))
    flights = tuple(Flight(f"gt_{name}.txt", f"est_stereo_{name}.txt", from_s) for name, from_s in names)
    fleet = Fleet(mavs=3, seed=1, duration_s=20.0)
    p = RecordedFlights(flights, str(EUROC), fleet, random_window=True).true.position
    assert min(np.linalg.norm(p[i] - p[i - 1]) for i in range(3)) >= 0.6
