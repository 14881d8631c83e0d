"""Do the bundled experiments show what they are there to show? The whole stack, in process, shortened."""

from pathlib import Path

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


@pytest.fixture(scope="module")
def first_run():
    return summaries("paper_run_1", "fleet.duration_s=12")


@pytest.mark.statistical
def test_the_papers_first_run_is_as_good_as_if_identities_were_known(first_run):
    assert mean(first_run, "relative", "rmse_m") <= 1.1 * mean(first_run, "clairvoyant", "relative", "rmse_m")
    assert mean(first_run, "relative", "rmse_m") <= 0.3 * mean(first_run, "naive", "relative", "rmse_m")  # 12 of 48 s
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
    (run,) = summaries("recorded_flights", f"world.flights_dir={EUROC}", seeds=range(1))
    assert run["relative"]["rmse_m"] < run["naive"]["relative"]["rmse_m"]
    assert run["relative"]["max_m"] < 0.5
    assert total_wrong([run]) == 0
    assert all(mav["state"] == "localised" for mav in run["mavs"])
