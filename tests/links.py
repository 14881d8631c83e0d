"""What one station hears of its peers over a bad network, for tests: late, lost, repeated, by seed."""

from typing import NamedTuple

import numpy as np

from agent.estimator.joint_update import DetectionSet
from agent.interface.frames import relative_pose, wrap


class Sent(NamedTuple):
    """One packet of one tick."""

    tick: int
    mav: int
    odometry: bool  # else its detection set


def perfect(ticks, station):
    """By tick, what is heard in it: everything at once."""
    mavs = range(1, len(ticks[0].truth) + 1)
    return [
        [Sent(k, mav, odometry) for mav in mavs if mav != station for odometry in (True, False)]
        for k in range(len(ticks))
    ]


def faulty(
    rng, ticks, station, loss=0.0, delay=0, jitter=0, burst=0, readings=True, sets=True, lost=lambda k, mav: False
):
    """By tick, what is heard in it.

    Args:
        loss: share of packets lost; in bursts of the mean length `burst`, if that is not 0.
        delay: ticks that every packet takes, and up to `jitter` more.
        readings, sets: whether these suffer.
        lost: whether what this MAV sends in this tick is lost in any case.
    """
    arrived = [[] for _ in ticks]
    down = dict.fromkeys(range(1, len(ticks[0].truth) + 1), False)
    for k, packets in enumerate(perfect(ticks, station)):
        for mav in down:
            end, begin = 1 / max(burst, 1), loss / (1 - loss) / max(burst, 1)
            down[mav] = burst > 0 and (rng.random() >= end if down[mav] else rng.random() < begin)
        for sent in packets:
            suffers = readings if sent.odometry else sets
            when = k + suffers * (delay + int(rng.integers(jitter + 1)))
            gone = down[sent.mav] if burst else rng.random() < loss
            if when < len(ticks) and not (suffers and gone) and not lost(k, sent.mav):
                arrived[when].append(sent)
    return arrived


def told(tick, mav):
    return DetectionSet(mav, tick.sets[mav], tick.labels[mav])


def untold(tick, mav):
    return DetectionSet(mav, tick.sets[mav])


def fly(history, ticks, arrived, station, seen=untold):
    """What the station believes, tick by tick."""
    for k, (tick, packets) in enumerate(zip(ticks, arrived, strict=True)):
        odometry, sets = {station: tick.odometry[station]}, [seen(tick, station)]
        for sent in packets:
            of = ticks[sent.tick]
            if sent.tick < k and sent.odometry:
                history.late(sent.tick, sent.mav, odometry=of.odometry[sent.mav])
            elif sent.tick < k:
                history.late(sent.tick, sent.mav, seen=seen(of, sent.mav))
            elif sent.odometry:
                odometry[sent.mav] = tick.odometry[sent.mav]
            else:
                sets.append(seen(tick, sent.mav))
        history.hear(k, odometry, sets)
        history.estimate()
        yield history.beliefs()


class Off(NamedTuple):
    """How far beliefs are off, relative to the station and in its body frame; the others only."""

    errors: np.ndarray  # (T, N - 1, 4) m, rad
    covariances: np.ndarray  # (T, N - 1, 4, 4)

    def rms_m(self):
        return float(np.sqrt((self.errors[..., :3] ** 2).sum(-1).mean()))

    def nees(self):
        """(T, N - 1) per dimension."""
        e = self.errors[..., None]
        return (e.swapaxes(-1, -2) @ np.linalg.solve(self.covariances, e))[..., 0, 0] / 4


def off(ticks, beliefs, station):
    errors, covariances = [], []
    for tick, believed in zip(ticks, beliefs, strict=True):
        others = [mav - 1 for mav in range(1, len(tick.truth) + 1) if mav != station]
        own, true = (np.tile(each[station - 1], (len(tick.truth), 1)) for each in (believed.poses, tick.truth))
        error = relative_pose(own, believed.poses) - relative_pose(true, tick.truth)
        error[:, 3] = wrap(error[:, 3])
        c, s = np.cos(own[0, 3]), np.sin(own[0, 3])
        turn = np.eye(4)
        turn[:2, :2] = [[c, s], [-s, c]]
        errors.append(error[others])
        covariances.append(turn @ believed.covariances[others] @ turn.T)
    return Off(np.array(errors), np.array(covariances))
