"""How near is the team to the formation that it flies? Pure functions on true positions.

A formation is where it is by estimates, so what counts is its shape: the error left after the translation and the turn
about the vertical that fit best.
"""

from typing import Any, NamedTuple

import numpy as np

from agent.interface.frames import Array, rotate_z
from agent.interface.intent import FORMING, HOLDING, NOWHERE
from agent.interface.mission import Mission, places
from agent.interface.tables import parse_table
from deploy.recording import Intents

LAST_S = 5.0  # of a run, over which the formation is judged


class Reached(NamedTuple):
    """How one leg of a mission went; NaN: it was not reached."""

    formation: str
    at_s: float  # from when on all were in formation
    rms_m: float  # from then on until the first one left


class Shape(NamedTuple):
    """The formation as it lies in the world."""

    goals: Array  # (n, 3) m
    rms_m: float  # of the distances to them


def mission_of(agent: dict[str, Any]) -> Mission | None:
    """What is flown, from an experiment's [agent] table."""
    return parse_table(Mission, agent["mission"], "agent.mission") if "mission" in agent else None


def fitted(positions: Array, goals: Array) -> Shape:
    """The goals (n, 3) moved and turned about the vertical as fits positions (n, 3) best, m."""
    center, middle = positions.mean(0), goals.mean(0)
    p, g = positions - center, goals - middle
    cross = (g[:, 0] * p[:, 1] - g[:, 1] * p[:, 0]).sum()
    turned = rotate_z(float(np.arctan2(cross, (g[:, :2] * p[:, :2]).sum())), g)
    return Shape(turned + center, float(np.sqrt(((p - turned) ** 2).sum(1).mean())))


def shapes(positions: Array, intents: Intents, mission: Mission) -> list[Shape | None]:
    """By tick, of positions (K, N, 3): None while not all that fly are in, or on the way to, one formation; those that
    are lost, land or are gone do not count."""
    found: list[Shape | None] = []
    for p, phase, formation, place in zip(positions, *intents, strict=True):
        flying = np.isin(phase, (FORMING, HOLDING)) & (place >= 0) & (place != NOWHERE)
        if flying.sum() < 2 or len(set(formation[flying].tolist())) > 1:
            found.append(None)
            continue
        goals = places(mission.legs[int(formation[flying][0])], positions.shape[1])
        found.append(fitted(p[flying], goals[place[flying]]))
    return found


def held_at(found: list[Shape | None], intents: Intents) -> list[int]:
    """The ticks at which all that say anything are in formation, of shapes (K)."""
    return [k for k, phase in enumerate(intents.phase) if found[k] is not None and (phase[phase >= 0] == HOLDING).all()]


def reached(found: list[Shape | None], intents: Intents, mission: Mission, time_s: Array) -> list[Reached]:
    """Leg by leg, of shapes (K)."""
    legs = []
    for number, leg in enumerate(mission.legs):
        held = [k for k in held_at(found, intents) if intents.formation[k].max() == number]
        squares = [shape.rms_m**2 for k in held if (shape := found[k]) is not None]
        at_s = float(time_s[held[0]]) if held else float("nan")
        legs.append(Reached(leg.formation, at_s, float(np.sqrt(np.mean(squares))) if held else float("nan")))
    return legs


def last_rms_m(found: list[Shape | None], rate_hz: float) -> float:
    """RMS distance to the desired places over the last seconds; NaN if no formation is held by then."""
    last = found[-round(LAST_S * rate_hz) :]
    squares = [shape.rms_m**2 for shape in last if shape is not None]
    return float(np.sqrt(np.mean(squares))) if len(squares) == len(last) and squares else float("nan")
