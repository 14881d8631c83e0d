"""Whom may the station call localised, and why not the others? The commit rule, MAV by MAV.

Two hypotheses that are *both exactly true*, as in a regular circle, differ by a random walk of a few nats a tick, so
the margin that a leader must have over its rivals grows with the root of the time: 12 nats are the odds e^12 once the
noise of the ratio is paid for. A start that can be decided gains linearly, tens of nats a tick. Where it is fewer, as
in a circle that is but centimetres from regular, the truth may not have been thought of yet, and hypotheses that are
all wrong differ just as much: there the leader has to last.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array
from agent.registration.hypotheses import LEAST_SIGMA, MARGIN, PER_SIGMA, Hypotheses

LEAST_TICKS = 4
STRONG, LASTING_TICKS = 3.5, 25  # nats a tick and MAV of the team by which it must lead, or so long it must have lasted
Mask = npt.NDArray[np.bool_]


class Verdict(NamedTuple):
    leader: int
    clear: Mask  # (N,) beyond every rival's reach, and fitting
    rivalled: Mask  # (N,) some rival inside the margin places it elsewhere
    margin: Array  # (N,) nats by which the best rival is behind what it must be; negative: inside
    rival: npt.NDArray[np.intp]  # (N,) index of that rival
    fitting: Mask  # (N,) explained by what the others see and by what it sees
    shares: Array  # (2, N) of its expected sightings that are explained: by the others, and as seen by itself
    ticks: int  # of the leader's evidence
    common: npt.NDArray[np.intp]  # (K,) of evidence that it has in common with each hypothesis


def judge(hypotheses: Hypotheses, P_D: float) -> Verdict:
    """Of every MAV, by the hypothesis that leads."""
    leader = int(hypotheses.recent().argmax())
    lead = hypotheses.lead(leader)
    least = LEAST_SIGMA * math.sqrt(max(hypotheses.bank.placed.shape[1], 7) / 7)  # more MAVs, more unknowns a tick
    n = int(lead.ticks[leader])
    excess = lead.nats - (MARGIN + PER_SIGMA * np.maximum(lead.walk, least * np.sqrt(lead.ticks)))
    if n < LASTING_TICKS:
        excess = np.minimum(excess, lead.nats - STRONG * hypotheses.bank.placed.shape[1] * lead.ticks)
    against = np.where(hypotheses.elsewhere()[leader], excess[:, None], np.inf)  # (K, N)
    against[leader] = np.inf
    margin, rival = against.min(0), against.argmin(0)
    placed = hypotheses.bank.placed[leader]
    fitting, shares = _fit(hypotheses, leader, P_D)
    fitting &= placed & _residuals_fit(hypotheses, leader)
    clear = fitting & (margin > 0) & (n >= LEAST_TICKS)
    return Verdict(leader, clear, placed & (margin <= 0), margin, rival, fitting, shares, n, lead.ticks)


def _fit(hypotheses: Hypotheses, k: int, P_D: float) -> tuple[Mask, Array]:
    """Whether each MAV is seen by the others as often as it should be, and sees them so; and the two shares.

    The directions apart: a MAV at the right place with a wrong yaw is seen all right.
    """
    expected, explained = hypotheses.expected[k], hypotheses.explained[k]
    counts = np.stack([expected.sum(0), expected.sum(1)])
    shares = np.stack([explained.sum(0), explained.sum(1)]) / np.maximum(counts, 1e-9)
    noise = 4 * np.sqrt(P_D * (1 - P_D) / np.maximum(counts, 1e-9))
    sure = noise < 0.45 * P_D
    fitting = sure & (shares > np.maximum(P_D - noise - 0.02, P_D / 2))
    return fitting.all(0), shares


def _residuals_fit(hypotheses: Hypotheses, k: int) -> bool:
    events = 3 * float(hypotheses.events[k])
    return events > 0 and float(hypotheses.square[k]) / events < 1.2 + 4 * math.sqrt(2 / events)
