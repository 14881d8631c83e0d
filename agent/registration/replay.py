"""How do new hypotheses catch up? They are taken through the last ticks, frame by frame, as if they had been there."""

from collections.abc import Callable, Generator, Sequence

from agent.registration.bank import Filter, Team, begin
from agent.registration.candidates import Placement
from agent.registration.hypotheses import Hypotheses
from agent.registration.window import Frame, Window, carried

TICKS = 5  # over which a new hypothesis is replayed
FIRST_ITERATIONS = 2  # of Gauss-Newton on the first frame, from the wide prior of a placement
CALL, STEP = 5000.0, 4.0  # cost of the filter's step: at all; per hypothesis, station, target and detection


def cost(hypotheses: Hypotheses, frame: Frame) -> float:
    """What one step of the filter costs, in detection-target pairs."""
    mavs, detections = frame.spherical.shape[:2]
    return CALL + STEP * float(len(hypotheses) * mavs**2 * max(detections, 1))


def team_at(team: Team, now: Frame, then: Frame) -> Team:
    """The team as its odometry says that it was a moment ago."""
    y = team.y.copy()
    y[:-1] = carried(y[:-1], now.odometry, then.odometry)
    return Team(y, team.P, team.placed)


def replay(
    sight: Filter,
    window: Window,
    placements: list[Placement],
    team: Team,
    newest: Frame,
    until: Callable[[], int],
    names: Sequence[int],
    best: Callable[[int, int], float],
) -> Generator[float, None, Hypotheses | None]:
    """The hypotheses that these placements make, once they know of all ticks; None if none is worth it.

    Yields what it has just cost.

    Args:
        sight: the bank's filter.
        window: the frames.
        placements: at the newest frame.
        team: at the same.
        newest: a frame of which the bank knows.
        until: the newest tick of which the bank knows, whenever asked: it goes on meanwhile.
        names: of the hypotheses.
        best: nats that the leader earned in so many ticks up to one: who is far behind is not taken further.
    """
    frames = [f for f in window.frames if f.tick <= newest.tick][-TICKS:]
    if not frames:
        return None
    first, tick = frames[0], frames[0].tick
    new = Hypotheses.fresh(begin(placements, team, newest, first), names)
    new.note(sight.update(new.bank, first, FIRST_ITERATIONS), burn_in=True)
    yield FIRST_ITERATIONS * cost(new, first)
    while tick < until():
        before, frame = window.at(tick), window.at(tick + 1)
        if before is None or frame is None:  # fallen so far behind that nothing is left to replay
            return None
        new.note(sight.step(new.bank, before, frame))
        tick += 1
        yield cost(new, frame)
        new = new.merged()
        new = new.without_hopeless(best(new.ticks, tick))
        if not len(new):
            return None
    return new
