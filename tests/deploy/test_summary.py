"""Does the summary say what the agents said of those whom they have not localised?"""

import dataclasses
from typing import Any

import numpy as np
import pytest

from agent.interface import messages
from agent.interface.messages import AMBIGUOUS, LOCALISED, SEARCHING
from deploy import summary
from deploy.recording import UNKNOWN, Recording
from tests.deploy.conftest import registration


def said(mav: int, reasons: list[str], hypotheses: int) -> messages.Registration:
    return messages.decode(messages.Registration, registration(mav, 1, reasons, hypotheses).payload, 1)


def summarised(recording: Recording) -> dict[str, Any]:
    analysis = summary.analyse(recording, recording.beliefs)
    return summary.summarise(analysis, summary.Circumstances("hand-made", "memory", 1.0))


@pytest.fixture
def states(recording: Recording) -> np.ndarray:
    """Everybody localised at all times, to be changed."""
    return np.full(recording.beliefs.states.shape, LOCALISED, np.uint8)


def with_words(recording: Recording, states: np.ndarray, **words: messages.Registration) -> Recording:
    registrations = {last.sender: last for last in words.values()}
    beliefs = recording.beliefs._replace(states=states)
    return dataclasses.replace(recording, beliefs=beliefs, registrations=registrations)


def test_the_reason_is_that_of_the_least_known_mav(recording: Recording, states: np.ndarray) -> None:
    states[-1, 0] = LOCALISED, AMBIGUOUS, SEARCHING
    states[-1, 1] = AMBIGUOUS, LOCALISED, LOCALISED
    first = said(1, ["", "a mirror image fits as well", "nobody fits"], 5)
    third = said(3, ["", "", ""], 1)
    content = summarised(with_words(recording, states, first=first, third=third))
    found = [(mav["state"], mav["reason"], mav["hypotheses"]) for mav in content["mavs"]]
    assert found == [("searching", "nobody fits", 5), ("ambiguous", None, None), ("localised", "", 1)]


def test_an_agent_that_gave_no_reason_or_said_nothing_has_none(recording: Recording, states: np.ndarray) -> None:
    states[:, 0] = UNKNOWN
    states[-1, 1] = AMBIGUOUS, LOCALISED, LOCALISED  # its registration of that tick was lost: the last says all is well
    words = {"first": said(1, ["", "x", "y"], 2), "second": said(2, ["", "", ""], 1)}
    mavs = summarised(with_words(recording, states, **words))["mavs"]
    assert [(mav["state"], mav["reason"]) for mav in mavs[:2]] == [("searching", None), ("ambiguous", None)]


def test_registration_is_scored_from_the_first_commits_on(recording: Recording, states: np.ndarray) -> None:
    found = summarised(with_words(recording, states))["registration"]
    relative = summary.analyse(recording, recording.beliefs).ours.relative
    pairs = ~np.eye(3, dtype=bool)
    assert found["position_1s_m"] == pytest.approx(np.median(relative.position_m[10, pairs]))
    assert found["yaw_1s_p95_rad"] == pytest.approx(np.percentile(relative.yaw_rad[10, pairs], 95))
    assert 0 < found["commit_nees"] < 10


def test_how_near_they_came_and_how_many_touched(recording: Recording) -> None:
    truth = recording.truth.copy()
    truth[7, 2, :3] = truth[7, 0, :3] + [0.3, 0.0, 0.4]
    bumped = dataclasses.replace(recording, truth=truth, touched={(1, 3), (2, 3)})
    assert summarised(bumped)["flight"] == {
        "nearest_m": pytest.approx(0.5),
        "collisions": 2,
        "formation_rms_m": None,
        "formations": [],
    }
    assert summarised(recording)["flight"]["nearest_m"] > 0.6
    assert summarised(recording)["flight"]["collisions"] == 0


def test_what_never_happened_is_null(recording: Recording, states: np.ndarray) -> None:
    states[:] = SEARCHING
    states[:, range(3), range(3)] = LOCALISED
    found = summarised(with_words(recording, states))["registration"]
    assert set(found.values()) == {None}
    assert '"commit_nees": null' in summary.to_json(found)
