"""How does a station get from nothing to a localised team? Proposals, a bank of hypotheses, challenge, commit.

Every tick the bank takes in what was heard. The rest (proposing joint placements, testing identity rivals) is a *job*,
sliced over ticks: it yields what each slice has cost, counted in detection-target pairs looked at, and goes on until
the tick's budget is spent. Counted work, not time: the same seed gives the same bits.
"""

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from agent.config import AgentConfig
from agent.interface.frames import Array
from agent.registration import places, replay
from agent.registration.bank import Filter, Team
from agent.registration.candidates import Placement, seen_from_station
from agent.registration.challenge import NEAR, challenge
from agent.registration.hypotheses import WINDOW, Hypotheses
from agent.registration.proposals import propose
from agent.registration.reasons import Situation, situation
from agent.registration.verdict import LEAST_TICKS, Verdict, judge
from agent.registration.waiting import Waiting
from agent.registration.window import Frame, Window

PROPOSAL_FRAMES = 8
WIDER = 3  # times as many placements are looked at, where many fit
LEAST_SLICES = 2  # a tick, however little work it may do: a replay has to gain on the time that goes by
HURRIED = 3  # times less work in a tick that is late
TOGETHER = 8  # hypotheses that are replayed at once
HASTY_ROUND_TICKS = 3  # between rounds of proposals while some MAV has no place that fits
ROUND_TICKS, LONGER = 20, 4  # between rounds that change nothing, at first; later at most so many times as long
CHALLENGE_TICKS = (4, 4, 8, 8, 8, 8, 16)  # between challenges of one leader, by how many have been fruitless
CHALLENGE_HOLDS_TICKS = 5
UNLIKE_TICKS = 3  # in which it shows that hypotheses that were equals are so no longer

Job = Generator[float, None, None]
Mask = npt.NDArray[np.bool_]


class Commit(NamedTuple):
    """MAVs that may be called localised, given whom the station has localised before."""

    tick: int  # the newest that the bank knows of
    mavs: npt.NDArray[np.intp]  # (C,) index
    y: Array  # (B, 4) mean of all at that tick
    P: Array  # (4N, 4N) of all but the station


class Challenged(NamedTuple):
    """When a hypothesis was last tested against exchanges of identity, and how that went."""

    tick: int
    saturated: Mask  # (N,) of whom more rivals are near than could be tested


class Registrar:
    """Of the station, which is index 0 of the MAVs here."""

    def __init__(self, config: AgentConfig, mavs: int, rate_hz: float) -> None:
        self._config, self._mavs = config, mavs
        self.filter = Filter(config, mavs, rate_hz)
        self._budget = config.registration.work_per_mav * mavs
        self._capacity = max(8, mavs + 1)
        self._lag = config.lag_ticks(rate_hz)
        self._team = Team(np.zeros((mavs + 1, 4)), np.zeros((4 * mavs, 4 * mavs)), np.arange(mavs) == 0)
        self.forget()

    def forget(self) -> None:
        """Begins anew: all that was heard, and all hypotheses."""
        self._window = Window(self._mavs, WINDOW + self._lag)
        self._done = -1  # tick of the last frame that the bank has taken in
        self._waiting = Waiting(self._mavs, self._lag, 0)
        self._restart()

    def _restart(self) -> None:
        self._hypotheses: Hypotheses | None = None
        self._verdict: Verdict | None = None
        self._challenged: dict[int, Challenged] = {}  # by name of the hypothesis, while it is in the bank
        self._job: Job | None = None
        self._round_at: int | None = None
        self._names = self._rounds = 0
        self._contested = False  # in the last round
        self._fruitless = 0  # challenges since a new one led or none did fit
        self._tested_at: int | None = None  # the tick of the last challenge
        self._alike = False  # it left everybody saturated, and all have done alike since: who leads is no news then

    def tick(self, tick: int, odometry: dict[int, Array], sets: dict[int, Array]) -> Frame:
        """Begins a tick with what was heard of it, by index; the station's own odometry is among it."""
        if self._window.frames and tick != self._window.frames[-1].tick + 1:
            self.forget()
        if not self._window.frames:  # everybody is waited for at first
            self._waiting = Waiting(self._mavs, self._lag, tick)
        frame = self._window.add(tick, odometry)
        self._waiting.heard(tick, [*odometry, *sets])
        for station, spherical in sets.items():
            frame.put(station, spherical)
            self._waiting.heard_set(tick, tick, station)
        return frame

    def late(self, tick: int, mav: int, *, odometry: Array | None = None, spherical: Array | None = None) -> None:
        """What came of an earlier tick, of one MAV (index); what was waited for in vain is of no use."""
        frame = self._window.at(tick)
        if frame is None or tick <= self._done:
            return
        now = self._window.frames[-1].tick + 1  # it is worked on in the tick to come
        self._waiting.heard(now, [mav])
        if odometry is not None:
            frame.put_odometry(mav, odometry)
        if spherical is not None:
            frame.put(mav, spherical)
            self._waiting.heard_set(now, tick, mav)

    def situation(self, ids: list[int], team: Mask) -> Situation:
        """How it stands, in words, with those not in the team (N,); for the MAV numbers by index."""
        now = self._window.frames[-1].tick if self._window.frames else 0
        silent = self._waiting.silence(now)
        challenged = self._lately(WINDOW)
        saturated = None if challenged is None else challenged.saturated
        past = self._past(WINDOW)
        mute = ~np.any([frame.heard for frame in past], axis=0) if past else np.ones(self._mavs, bool)
        return situation(self._hypotheses, self._verdict, saturated, team, silent, mute, len(past), ids)

    def advance(self, placed: Mask) -> list[Frame]:
        """Takes in the ticks of which all is there that will be, and returns them; with these MAVs (N,) localised."""
        self._team = Team(self._team.y, self._team.P, placed)
        ripe = self._ripe()
        for frame in ripe:
            self._advance(frame)
        return ripe

    @property
    def newest(self) -> int:
        """The newest tick that is taken in; -1 if none is."""
        return self._done

    def work_on(self, team: Team, hurried: bool = False) -> Commit | None:
        """Does this tick's share of the work for those not in the team, given as it was at the newest tick that is
        taken in; returns whom to call localised then.

        Args:
            hurried: it is late already: less, and where challenges have decided nothing the least that leads on.
        """
        self._team = team
        if team.placed.all():
            self._restart()
            return None
        self._drop_those_against(team)
        # Where challenges have decided nothing, there is no hurry.
        spent, slices, budget = 0.0, 0, self._budget / max(self._fruitless, 1)
        if hurried:
            budget = 0.0 if self._fruitless else budget / HURRIED
        while spent < budget or slices < LEAST_SLICES:
            slices += 1
            self._job = self._job or self._next_job()
            if self._job is None:
                break
            try:
                spent += next(self._job)
            except StopIteration:
                self._job = None
        return self._commit()

    def _ripe(self) -> list[Frame]:
        """The frames of which all is there that will be, and that the bank has not taken in yet."""
        frames = [frame for frame in self._window.frames if frame.tick > self._done]
        ripe = frames[: self._waiting.over(frames)]
        for frame in ripe:
            self._window.settle(frame)
            self._done = frame.tick
        self._waiting.done(self._done)
        return ripe

    def _advance(self, frame: Frame) -> None:
        before = self._window.at(frame.tick - 1)
        if self._hypotheses is not None and before is not None:
            self._hypotheses.note(self.filter.step(self._hypotheses.bank, before, frame))
            self._keep(self._hypotheses.merged())

    def _drop_those_against(self, team: Team) -> None:
        """Drops hypotheses that place a MAV of the team elsewhere than it is."""
        frame = self._window.at(self._done)
        if self._hypotheses is None or frame is None or team.placed.sum() == 1:
            return
        against = self._hypotheses.against(team.y[:-1], team.placed)
        if against.all():
            self._restart()
        elif against.any():
            self._keep(self._hypotheses.of([int(k) for k in np.flatnonzero(~against)]))

    def _past(self, most: int) -> list[Frame]:
        """The last frames that the bank has taken in."""
        return [f for f in self._window.frames if f.tick <= self._done][-most:]

    def _next_job(self) -> Job | None:
        if len(self._past(LEAST_TICKS)) < LEAST_TICKS:
            return None
        verdict, missing = self._verdict, ~self._team.placed
        if verdict is not None:
            due = (verdict.clear & missing).any() and self._lately(CHALLENGE_HOLDS_TICKS) is None
            unfit = not verdict.fitting.any()  # its places may be right, and its names wrong
            rivalled = unfit or (verdict.rivalled & verdict.fitting & missing).any()
            if due or (rivalled and self._may_test()):
                return self._test(verdict)
        unplaced = verdict is None or (verdict.ticks >= LEAST_TICKS and (~verdict.fitting & ~self._settled()).any())
        pause = HASTY_ROUND_TICKS if unplaced or self._wide() else ROUND_TICKS * min(2**self._fruitless, LONGER)
        if self._round_at is None or self._done - self._round_at >= pause:
            self._round_at, self._rounds = self._done, self._rounds + 1
            return self._round(verdict if unplaced and self._rounds % 2 == 0 else None)
        return None

    def _may_test(self) -> bool:
        """Whether there has been no challenge of the leader lately; or of whom it takes turns with."""
        pause = CHALLENGE_TICKS[self._fruitless]
        if self._alike and self._tested_at is not None:
            return self._done - self._tested_at > pause
        return self._lately(pause) is None

    def _round(self, verdict: Verdict | None) -> Job:
        """Proposes joint placements: from the team, or from all whom the leading hypothesis has right."""
        past = self._past(PROPOSAL_FRAMES)
        base = self._base(verdict, past[-1])
        missing = [int(j) for j in np.flatnonzero(~base.placed)]
        wide = self._wide()
        proposed = yield from propose(self._config, past, base, missing, self._capacity * (WIDER if wide else 1))
        self._contested = proposed.contested and not wide
        found = [each for each in proposed.placements if each.placed.sum() > base.placed.sum() and each.placed[0]]
        yield from self._add([seen_from_station(each, past[-1]) for each in found], past[-1])

    def _wide(self) -> bool:
        """Whether to look once more, and wider: so many placements fit, but not for symmetry, as far as one knows."""
        return self._contested and not self._alike

    def _team_at(self, frame: Frame) -> Team:
        known = self._window.at(self._done)
        return self._team if known is None else replay.team_at(self._team, known, frame)

    def _settled(self) -> Mask:
        """(N,) who is not in question: the team, but not the station as long as it is alone."""
        return np.asarray(self._team.placed & (self._team.placed.sum() > 1))

    def _base(self, verdict: Verdict | None, frame: Frame) -> Placement:
        team = self._team_at(frame)
        poses, P, placed = team.y[:-1], team.P, team.placed
        if verdict is not None and self._hypotheses is not None and (self._settled() | verdict.fitting).sum() > 1:
            bank = self._hypotheses.bank
            poses, P = bank.y[verdict.leader, :-1].copy(), bank.P[verdict.leader]
            placed = self._settled() | verdict.fitting
        covariances = np.zeros((self._mavs, 4, 4))
        for j in np.flatnonzero(placed[1:]) + 1:
            covariances[j] = P[4 * j - 4 : 4 * j, 4 * j - 4 : 4 * j]
        return Placement(poses, covariances, placed)

    def _test(self, verdict: Verdict) -> Job:
        """Tests the leader against those who would exchange identities on its places."""
        assert self._hypotheses is not None
        name = int(self._hypotheses.names[verdict.leader])
        past = self._past(max(places.FRAMES, verdict.ticks))  # what a few ticks do not tell, all that it has lasted may
        found = yield from challenge(self._config, self._hypotheses, verdict.leader, past, self._team.placed)
        yield from self._add(found.rivals, past[-1])
        self._challenged[name] = Challenged(self._done, found.saturated)
        self._tested_at, self._alike = self._done, bool(found.saturated[~self._team.placed].all())
        self._fruitless = min(self._fruitless + 1, len(CHALLENGE_TICKS) - 1)

    def _add(self, placements: list[Placement], newest: Frame) -> Job:
        """New hypotheses of this frame, once they have caught up."""
        for some in range(0, len(placements), TOGETHER):
            part = placements[some : some + TOGETHER]
            team = self._team_at(newest)
            names = range(self._names, self._names + len(part))
            self._names += len(part)
            new = yield from replay.replay(
                self.filter, self._window, part, team, newest, lambda: self._done, names, self._best
            )
            if new is not None:
                self._keep(new.merged() if self._hypotheses is None else self._hypotheses.joined(new))

    def _best(self, ticks: int, tick: int) -> float:
        """Nats that the leader earned in so many ticks up to this one."""
        if self._hypotheses is None or self._verdict is None:
            return -np.inf
        return self._hypotheses.earned(self._verdict.leader, ticks, self._done - tick)

    def _keep(self, hypotheses: Hypotheses) -> None:
        """Keeps the leader, for every MAV the best that places it elsewhere, then the best of the rest."""
        kept = hypotheses.worth(self._capacity, ~self._team.placed)
        self._hypotheses = hypotheses if len(kept) == len(hypotheses) else hypotheses.of(kept)
        before, self._verdict = self._verdict, judge(self._hypotheses, self._config.detector.P_D)
        if before is not None and before.fitting.any() and not self._verdict.fitting.any():
            self._job, self._challenged = None, {}  # what was begun in other circumstances is of no use
        names = self._hypotheses.names.tolist()
        self._challenged = {name: each for name, each in self._challenged.items() if name in names}
        unlike = self._alike and self._hypotheses.spread(UNLIKE_TICKS) > NEAR * UNLIKE_TICKS**0.5
        self._alike = self._alike and not unlike
        new = names[self._verdict.leader] not in self._challenged and not self._alike
        if unlike or new or not self._verdict.fitting.any():
            self._fruitless = 0  # something has changed

    def _lately(self, ticks: int) -> Challenged | None:
        """How the leader's challenge went, if there was one in so many last ticks."""
        if self._verdict is None or self._hypotheses is None:
            return None
        challenged = self._challenged.get(int(self._hypotheses.names[self._verdict.leader]))
        return challenged if challenged is not None and self._done - challenged.tick <= ticks else None

    def _commit(self) -> Commit | None:
        verdict, challenged = self._verdict, self._lately(CHALLENGE_HOLDS_TICKS)
        if challenged is None or verdict is None or self._hypotheses is None:
            return None
        ready = verdict.clear & ~self._team.placed & ~challenged.saturated
        # While one that has a place may stand elsewhere, what is seen of it would be taken for its neighbours.
        ambiguous = (verdict.rivalled | challenged.saturated) & ~self._team.placed
        if not ready.any() or not verdict.fitting[0] or ambiguous.any():
            return None
        bank = self._hypotheses.bank
        return Commit(self._done, np.flatnonzero(ready), bank.y[verdict.leader], bank.P[verdict.leader])
