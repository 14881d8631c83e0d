"""What goes into summary.json? Every figure of a run, from its recording alone."""

import json
import math
from typing import Any, NamedTuple

import numpy as np

from agent.interface.frames import Array
from agent.interface.messages import LOCALISED, STATES, floats
from agent.interface.mission import Mission
from deploy import commits, metrics
from deploy.faults import Faults
from deploy.formation import Reached, Shape, last_rms_m, reached, shapes
from deploy.metrics import Errors, Mask, Score
from deploy.pairs import Pairs, first_of_spell, late_starts, localised_since, pairs_of
from deploy.recording import Beliefs, Recording

WORLD = 0  # sender of the world's status
NONE = Faults()


class Course(NamedTuple):
    """How the errors of one way of localising went over the run, and where they are scored."""

    relative: Errors
    absolute: Errors
    known: Mask  # (K, N, N) from when j is called localised on, while both are alive and connected
    scored: Mask  # (K, N, N) a little later
    cut_off: Mask  # (K, N, N) as known, while they are alive, but not connected

    def scores(self, time_s: Array) -> dict[str, Score]:
        return {name: metrics.score(getattr(self, name), self.scored, time_s) for name in ("relative", "absolute")}


class Analysis(NamedTuple):
    """What the summary and the figures are made of."""

    recording: Recording
    ours: Course
    naive: Course
    clairvoyant: Course
    nees: Array  # (K, N, N)
    faults: Faults
    since_s: Array  # (K, N, N) since when i has called j localised, in the present lives of both
    across: dict[str, Score]  # relative errors of pairs that a fault keeps apart; naive: dead reckoning from the cut
    shapes: list[Shape | None] | None  # (K) of the formations that were flown; None without a mission
    legs: list[Reached]  # of the mission


def analyse(recording: Recording, twin: Beliefs, faults: Faults = NONE, mission: Mission | None = None) -> Analysis:
    """Errors of the recording's estimates, of the naive baseline and of the clairvoyant twin, and of what was flown."""
    true_poses, time_s = recording.true_poses, recording.time_s
    origins = metrics.origins_of_lives(true_poses, recording.odometry, recording.incarnations)
    true_absolute = metrics.absolute_from_world(origins, true_poses)
    true_relative = metrics.relative_from_absolute(true_absolute)
    pairs = pairs_of(recording.incarnations, faults, time_s)

    def course(absolute: Array, since_s: Array) -> Course:
        relative = metrics.errors(metrics.relative_from_absolute(absolute), true_relative)
        known = time_s[:, None, None] >= since_s
        return Course(
            relative,
            metrics.errors(absolute, true_absolute),
            known & pairs.alive & pairs.connected,
            metrics.settled(since_s, time_s) & pairs.again,
            known & pairs.cut_off,
        )

    def since(beliefs: Beliefs) -> Array:
        return localised_since(beliefs.states, recording.incarnations, time_s)

    always = np.full(recording.beliefs.states.shape[1:], -np.inf)
    flown = None if mission is None else shapes(recording.truth[..., :3], recording.intents, mission)
    courses = {
        "ours": course(recording.beliefs.absolute, since(recording.beliefs)),
        "clairvoyant": course(twin.absolute, since(twin)),
        "naive": course(metrics.naive_absolute(origins, recording.odometry), always),
    }
    return Analysis(
        recording=recording,
        **courses,
        nees=metrics.nees(recording.beliefs.estimates, recording.covariances, true_relative),
        faults=faults,
        since_s=since(recording.beliefs),
        across=_across(recording, pairs, courses, true_relative),
        shapes=flown,
        legs=[] if mission is None or flown is None else reached(flown, recording.intents, mission, time_s),
    )


def _across(recording: Recording, pairs: Pairs, courses: dict[str, Course], true_relative: Array) -> dict[str, Score]:
    """Of those pairs that had settled when they were cut off from each other; the same ones for all."""
    if not pairs.cut_off.any():
        return {}
    began = first_of_spell(pairs.cut_off)
    i, j = np.indices(began.shape[1:])
    scored = pairs.cut_off & courses["ours"].scored[np.maximum(began - 1, 0), i, j]
    reckoned = metrics.errors(metrics.dead_reckoned(true_relative, recording.odometry, began), true_relative)
    errors = {name: course.relative for name, course in courses.items()} | {"naive": reckoned}
    return {name: metrics.score(error, scored, recording.time_s) for name, error in errors.items()}


class Circumstances(NamedTuple):
    """What the recording does not say of itself."""

    experiment: str
    transport: str  # zenoh | memory
    wall_s: float | None


def summarise(analysis: Analysis, circumstances: Circumstances) -> dict[str, Any]:
    """The content of summary.json; what could not be measured is None."""
    recording, fleet = analysis.recording, analysis.recording.fleet
    time_s, wall_s = recording.time_s, circumstances.wall_s
    sim_s = recording.ticks / fleet.rate_hz
    baselines = {
        name: {kind: score._asdict() for kind, score in course.scores(time_s).items()}
        for name, course in (("naive", analysis.naive), ("clairvoyant", analysis.clairvoyant))
    }
    summary = {
        "experiment": circumstances.experiment,
        "seed": fleet.seed,
        "mode": "realtime" if fleet.realtime else "lockstep",
        "transport": circumstances.transport,
        "agents": fleet.mavs,
        "ticks": recording.ticks,
        "sim_s": sim_s,
        "wall_s": wall_s,
        "real_time_factor": sim_s / wall_s if wall_s else None,
        "late_ticks": recording.statuses[WORLD].late_ticks if WORLD in recording.statuses else None,
        **{kind: score._asdict() for kind, score in analysis.ours.scores(time_s).items()},
        **baselines,
        "anees": metrics.anees(analysis.nees, analysis.ours.scored),
        "nis_inside": metrics.nis_inside(recording.innovations),
        "disagreement_m": metrics.disagreement_m(recording.beliefs.estimates, recording.beliefs.states),
        "registration": _registration(analysis),
        "across_cuts": {name: score._asdict() for name, score in analysis.across.items()} or None,
        "flight": {
            "nearest_m": metrics.nearest_m(recording.truth[..., :3]),
            "collisions": len(recording.touched),
            "formation_rms_m": None if analysis.shapes is None else last_rms_m(analysis.shapes, fleet.rate_hz),
            "formations": [leg._asdict() for leg in analysis.legs],
        },
        "estimator_ms": _estimator_ms(recording),
        "network": _network(recording, sim_s),
        "mavs": _mavs(analysis),
        "late_starts": [each._asdict() for each in late_starts(recording, analysis.since_s)],
    }
    strict: dict[str, Any] = _strict(summary)
    return strict


def to_json(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _registration(analysis: Analysis) -> dict[str, float]:
    recording = analysis.recording
    found = commits.at_commit(recording.beliefs.states, analysis.nees, analysis.ours.relative, recording.time_s)
    return found._asdict()


def _estimator_ms(recording: Recording) -> dict[str, float]:
    ticks = recording.tick_us[np.isfinite(recording.tick_us)]
    stations = np.array([us for costs in recording.station_us for us in costs], float)
    return {
        f"{name}_p{percent}": float(np.percentile(values, percent)) / 1000 if len(values) else math.nan
        for name, values in (("station", stations), ("tick", ticks))
        for percent in (50, 99)
    }


def _network(recording: Recording, sim_s: float) -> dict[str, Any]:
    """Sums over the agents' last words (the world's are not counted)."""
    last = [status for sender, status in recording.statuses.items() if sender != WORLD]
    agents = [*last, *(status for status in recording.former_statuses if status.sender != WORLD)]
    sums = {
        name: sum(getattr(status, name) for status in agents)
        for name in ("sent", "received", "rejected", "late", "duplicate")
    }
    rate = sum(status.sent_bytes for status in agents) / len(last) / sim_s if agents and sim_s else math.nan
    return {**sums, "dropped_by_faults": int(recording.dropped.sum()), "bytes_per_agent_s": rate}


def _mavs(analysis: Analysis) -> list[dict[str, Any]]:
    recording, states = analysis.recording, analysis.recording.beliefs.states
    at_s = commits.all_localised_at(states, recording.time_s)
    wrong = commits.wrong_commits(analysis.ours.relative, states)
    content = []
    for mav in recording.fleet.ids:
        least, registration = commits.least_known_at_last(states, mav - 1), recording.registrations.get(mav)
        reason = "" if least.state == LOCALISED else None
        if least.mav is not None and registration is not None:
            reason = registration.reasons[least.mav] or None
        content.append(
            {
                "id": mav,
                "state": STATES[least.state],
                "reason": reason,
                "hypotheses": None if registration is None else len(floats(registration.weights)),
                "localised_at_s": float(at_s[mav - 1]),
                "wrong_commits": int(wrong[mav - 1]),
                "restarts": sum(fault.mav == mav and fault.do == "restart" for fault in recording.process_faults),
            }
        )
    return content


def _strict(value: Any) -> Any:
    """JSON has no NaN and no infinity: None says that there is no such number."""
    if isinstance(value, dict):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_strict(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
