"""How far a guess is off, and how far it says that it might be."""

import numpy as np
import pytest

from agent.config import AgentConfig
from agent.estimator.motion import Model, Motion
from agent.interface.fleet import Fleet

MAVS = 6
DRIFT = np.array([0.01, 0.01, 0.01, 0.002])


def model(**fleet):
    return Model.of(AgentConfig(), Fleet(mavs=MAVS, **fleet))


def stepped(path, heard=lambda k, i: True, seed=0, noise=1.0, motion=None):
    """Motion after these true poses (T, N, 4), read with drift, and every step on the way."""
    rng, motion, steps = np.random.default_rng(seed), motion or Motion.begin(model(), MAVS), []
    readings = path + noise * np.cumsum(rng.normal(size=path.shape) * DRIFT, axis=0)
    for k, reading in enumerate(readings):
        z = np.vstack([reading, np.zeros(4)])
        z[[i for i in range(MAVS) if not heard(k, i)]] = np.nan
        step = motion.step(z, np.zeros(MAVS + 1, int))
        steps.append(step)
        motion = step.motion
    return motion, steps


def hover(ticks):
    return np.zeros((ticks, MAVS, 4))


def straight(ticks, speed=0.5):
    return np.arange(ticks)[:, None, None] * np.array([0.1 * speed, 0, 0, 0]) * np.ones((1, MAVS, 1))


def swing(ticks, amplitude=1.0, period_s=4.0):
    angle = 2 * np.pi * (np.arange(ticks)[:, None] / 10 / period_s + np.arange(MAVS) / MAVS)
    return amplitude * np.stack([np.cos(angle), np.sin(angle), 0 * angle, 0 * angle], axis=-1)


def setting_out(ticks, rest=100, far_m=1.3, takes_s=5.0):
    """All at rest, then as far as that, smoothly, in a direction each."""
    share = np.clip((np.arange(ticks) - rest) / 10 / takes_s, 0, 1)[:, None]
    smooth = far_m * (10 * share**3 - 15 * share**4 + 6 * share**5)
    angle = 2 * np.pi * np.arange(MAVS) / MAVS
    return np.stack([smooth * np.cos(angle), smooth * np.sin(angle), 0 * smooth * angle, 0 * smooth * angle], axis=-1)


def off(path, lost_from, ticks, seeds):
    """(seeds, N) how far guesses are off in x after a silence, less drift, and what they said that they would be."""
    errors, said = [], []
    for seed in range(seeds):
        _, steps = stepped(path[: lost_from + ticks], lambda k, i: k < lost_from, seed)
        guessed = np.sum([s.increments[:-1] for s in steps[lost_from:]], axis=0)
        true = path[lost_from + ticks - 1] - path[lost_from - 1]
        errors.append((guessed - true)[:, :2].ravel())
        said.append(np.repeat(np.sum([s.sigma[:-1, 0] ** 2 for s in steps[lost_from:]], axis=0), 2))
    return np.array(errors), np.array(said)


@pytest.mark.statistical
@pytest.mark.parametrize("ticks", [1, 3, 5, 10])
@pytest.mark.parametrize("path", [hover, straight, swing])
def test_a_guess_is_as_far_off_as_it_says(path, ticks):
    errors, said = off(path(120), 100, ticks, seeds=12)
    assert 0.25 < (errors**2 / said).mean() < 1.6


@pytest.mark.parametrize("ticks", [3, 10])
def test_one_who_hovers_is_surer_than_one_who_manoeuvres(ticks):
    assert off(hover(120), 100, ticks, 1)[1].mean() < 0.3 * off(swing(120), 100, ticks, 1)[1].mean()


@pytest.mark.parametrize("ticks", [20, 30, 50])
def test_who_is_silent_from_a_moment_of_rest_may_have_set_out(ticks):
    errors, said = off(setting_out(160), 100, ticks, seeds=12)
    assert np.sqrt(said.mean()) > AgentConfig().localised_sigma_m
    assert (errors**2 / said).max() < 3.5**2


def test_one_increment_is_not_believed_but_the_mean_of_several():
    """Hovering: what the last increment says is drift."""
    errors, _ = off(hover(120), 100, 5, seeds=12)
    assert errors.std() < 0.5 * 5 * DRIFT[0]


def test_who_is_silent_for_long_comes_to_rest_and_grows_uncertain_without_bound():
    motion, steps = stepped(straight(400), lambda k, i: i != 2 or k < 50, noise=0.1)
    moved = np.array([s.increments[2, 0] for s in steps])
    assert moved[52] == pytest.approx(0.05, rel=0.1)
    assert moved[150] < 1e-3 < moved[70]
    growth = np.array([s.sigma[2, 0] for s in steps]) ** 2
    assert growth[350] > 1e-4
    assert motion.unheard[2] == 350
    assert motion.here[2, 0] - 50 * 0.05 < 2.0
    # It might have gone straight on for 10 s: within three and a half standard deviations.
    assert 3.5 * np.sqrt(growth[50:150].sum()) > 100 * 0.05 - moved[50:150].sum()


def test_a_step_changes_nothing_of_what_was_before():
    motion, _ = stepped(swing(30))
    before = [np.array(getattr(motion, name)) for name in ("past", "velocities", "here", "unheard", "errors", "counts")]
    motion.step(np.full((MAVS + 1, 4), np.nan), np.zeros(MAVS + 1, int))
    for name, old in zip(("past", "velocities", "here", "unheard", "errors", "counts"), before, strict=True):
        np.testing.assert_array_equal(getattr(motion, name), old)


def test_a_leap_teaches_no_more_than_a_violent_manoeuvre():
    """One that lies, or begins anew, must not make all the others uncertain for ever."""
    path = hover(60)
    path[40:, 1] += 1e5
    motion, _ = stepped(path)
    violent, _ = stepped(swing(60, amplitude=3.0, period_s=4.0))
    assert motion._spread()[3, 0] < 5 * violent._spread()[3, 0]


@pytest.mark.parametrize(
    ("moved", "ticks", "anew"),
    [
        ([1.4, 0, 0, 0], 1, False),
        ([1.6, 0, 0, 0], 1, True),
        ([0, 0, 0, 1.1], 1, True),
        ([0.3, 0, 0, 0.1], 5, False),
        ([4.0, 0, 0, 0], 5, True),
        ([0, 0, 0, 2.0], 5, True),
        ([0, 0, 0, 2 * np.pi], 5, False),
    ],
)
def test_whether_an_odometry_has_begun_anew(moved, ticks, anew):
    motion, _ = stepped(hover(60))
    assert motion.begun_anew(np.zeros(4), np.array(moved, float), ticks, 0, np.zeros(4)) == anew


def test_who_was_never_heard_cannot_begin_anew():
    motion = Motion.begin(model(), MAVS)
    assert not motion.begun_anew(motion.here[0], np.ones(4) * 1e3, 1, 0, np.zeros(4))


@pytest.mark.parametrize("rate_hz", [0.1, 1.0, 50.0])
def test_at_any_rate_there_is_something_to_average(rate_hz):
    motion = Motion.begin(model(rate_hz=rate_hz), MAVS)
    for k in range(5):
        step = motion.step(np.full((MAVS + 1, 4), 0.01 * k), np.zeros(MAVS + 1, int))
        motion = step.motion
    step = motion.step(np.full((MAVS + 1, 4), np.nan), np.zeros(MAVS + 1, int))
    assert np.isfinite(step.increments).all()
    assert np.isfinite(step.sigma).all()
