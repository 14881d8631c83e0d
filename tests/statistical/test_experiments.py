"""Do the bundled experiments show what they are there to show? The whole stack, in process, shortened."""

import math
from pathlib import Path

import numpy as np
import pytest

from deploy.metrics import anees_band
from deploy.study import jobs, run_one

EUROC = Path(__file__).parents[3] / "shared" / "datasets" / "euroc_vio"
SEEDS = range(2)


def summaries(experiment, *changes, seeds=SEEDS):
    return [run_one(job) for job in jobs(experiment, list(changes), seeds, [])]


def mean(runs, *path):
    values = []
    for value in runs:
        for step in path:
            value = value[step]
        values.append(value)
    return sum(values) / len(values)


def total_wrong(runs):
    return sum(mav["wrong_commits"] for run in runs for mav in run["mavs"])


def localised_at_s(runs):
    """When each agent of each run had localised all others; infinite: never."""
    times = [mav["localised_at_s"] for run in runs for mav in run["mavs"]]
    return [math.inf if time_s is None else time_s for time_s in times]


@pytest.fixture(scope="module")
def first_run():
    return summaries("paper_run_1", "fleet.duration_s=10")


@pytest.mark.statistical
def test_the_papers_first_run_is_as_good_as_if_identities_were_known(first_run):
    assert mean(first_run, "relative", "rmse_m") <= 1.1 * mean(first_run, "clairvoyant", "relative", "rmse_m")
    assert mean(first_run, "relative", "rmse_m") <= 0.3 * mean(first_run, "naive", "relative", "rmse_m")  # 10 of 54 s
    assert mean(first_run, "absolute", "rmse_m") <= mean(first_run, "naive", "absolute", "rmse_m")
    assert total_wrong(first_run) == 0


@pytest.mark.statistical
def test_it_knows_how_wrong_it_is(first_run):
    low, high = anees_band(len(SEEDS), 7)
    assert low < mean(first_run, "anees") < high


@pytest.mark.statistical
def test_agents_that_believe_half_the_drift_do_not():
    halved = ("agent.odometry.position_sigma_m=0.005", "agent.odometry.yaw_sigma_rad=0.001")
    runs = summaries("paper_run_1", "fleet.duration_s=8", "fleet.mavs=4", *halved)
    assert mean(runs, "anees") > anees_band(len(SEEDS), 4)[1]


@pytest.mark.statistical
@pytest.mark.skipif(not EUROC.is_dir(), reason="the EuRoC trajectories are not here")
def test_three_recorded_flights_are_never_lost():
    (run,) = summaries("recorded_flights", f"world.flights_dir={EUROC}", "fleet.duration_s=30", seeds=range(1))
    assert run["relative"]["rmse_m"] < run["naive"]["relative"]["rmse_m"]
    assert run["relative"]["max_m"] < 0.5
    assert total_wrong([run]) == 0
    assert all(mav["state"] == "localised" for mav in run["mavs"])


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("changes", "within_s"),
    [((), 1.5), (("world.detector.P_D=0.7", "world.detector.false_per_set=1.0"), 2.0)],
)
def test_from_random_places_told_nothing_all_localise_all(changes, within_s):
    runs = summaries("cold_start", "fleet.duration_s=3", *changes)
    assert max(localised_at_s(runs)) <= within_s
    assert total_wrong(runs) == 0
    assert mean(runs, "registration", "position_1s_p95_m") < 0.15


@pytest.mark.statistical
def test_where_no_measurement_can_tell_nobody_is_localised():
    (run,) = runs = summaries("cold_start_symmetric", "fleet.duration_s=5", seeds=range(1))
    assert run["registration"]["commit_nees"] is None  # nobody ever called anybody localised
    assert total_wrong(runs) == 0
    assert {mav["state"] for mav in run["mavs"]} == {"ambiguous"}
    assert min(mav["hypotheses"] for mav in run["mavs"]) > 1
    assert all("equally well" in mav["reason"] for mav in run["mavs"])


@pytest.mark.statistical
def test_a_take_off_to_different_heights_tells_who_is_who():
    """The circle takes off from 1 to 2.5 s."""
    runs = summaries("cold_start_circle", "fleet.duration_s=5", seeds=range(1))
    times_s = localised_at_s(runs)
    assert min(times_s) > 1
    assert np.median(times_s) <= 3
    assert max(times_s) <= 3.5
    assert total_wrong(runs) == 0
    low, high = anees_band(1, 7)
    assert low < mean(runs, "anees") < high


@pytest.mark.statistical
@pytest.mark.parametrize("faults", [(), ("faults.loss=0.2", "faults.delay_ms=100")])
def test_told_nothing_they_take_off_and_form_a_line(faults):
    line = 'agent.mission.legs=[{formation="line", length_m=3.0, hold_s=60.0}]'
    (run,) = summaries("formation_line", "fleet.mavs=3", "fleet.duration_s=18", line, *faults, seeds=range(1))
    assert run["flight"]["formation_rms_m"] < 0.1
    assert run["flight"]["nearest_m"] > 0.65
    assert run["flight"]["collisions"] == 0
    assert total_wrong([run]) == 0


@pytest.mark.statistical
@pytest.mark.skipif(not EUROC.is_dir(), reason="the EuRoC trajectories are not here")
def test_three_recorded_flights_told_nothing_localise_themselves():
    runs = summaries("cold_start_recorded", f"world.flights_dir={EUROC}", "fleet.duration_s=8", seeds=range(1))
    assert max(localised_at_s(runs)) <= 1.5
    assert total_wrong(runs) == 0
    assert all(run["relative"]["rmse_m"] < run["naive"]["relative"]["rmse_m"] for run in runs)


@pytest.fixture(scope="module")
def overconfident():
    """Agents that believe a tenth of their detectors' bearing noise."""
    return summaries("cold_start", "fleet.duration_s=2", "agent.detector.bearing_sigma_rad=0.0008")


@pytest.mark.statistical
def test_agents_that_believe_a_tenth_of_the_bearing_noise_do_not_localise_or_are_not_consistent(overconfident):
    _, high = anees_band(1, 7)
    for run in overconfident:
        assert max(localised_at_s([run])) == math.inf or run["anees"] > 3 * high


@pytest.mark.statistical
def test_agents_that_believe_a_tenth_of_the_bearing_noise_localise_nobody_wrongly(overconfident):
    assert total_wrong(overconfident) == 0


NARROW = ("faults.partitions=[]", "faults.processes=[]", "fleet.duration_s=10.0")


@pytest.mark.statistical
@pytest.mark.parametrize(("fov_azimuth_rad", "share"), [(3.14, 0.0), (4.2, 0.5)])
def test_detectors_that_do_not_look_all_around_tell_less_but_nothing_wrong(fov_azimuth_rad, share):
    """Some see nobody, and may stand wherever somebody is seen."""
    runs = summaries("cut_and_crash", f"world.detector.fov_azimuth_rad={fov_azimuth_rad}", *NARROW, seeds=range(3))
    assert total_wrong(runs) == 0
    assert np.mean(np.isfinite(localised_at_s(runs))) > share
