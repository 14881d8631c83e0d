"""Where are the MAVs, and what does their odometry read, when recorded flights are played instead of simulated ones?"""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from agent.interface import messages
from agent.interface.fleet import Fleet
from agent.interface.frames import Array, compose, inverse, rotate_z, rotation_matrix
from agent.interface.seeds import generator
from agent.interface.tables import BadExperiment
from world.clearance import CLEARANCE_M, are_apart, drawn_until
from world.poses import Poses, multiply, quaternion_of, turn_z
from world.tracks import MAX_GAP_S, Track, poses_at, read_track, without_placeholders


class Flight(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One MAV's recorded flight: two TUM files (t x y z qx qy qz qw; white space or commas; # comments) that keep one
    time, the truths of all flights in one gravity-aligned frame."""

    truth: str  # file in flights_dir
    vio: str  # file in flights_dir; its frame is gravity-aligned too
    from_s: float = 0.0  # tick 0 is the first VIO row at or after this time since both files have begun


class Recording(NamedTuple):
    """One flight's files."""

    truth: Track
    vio: Track
    start_s: Array  # (K,) rising, K > 0: the VIO rows from from_s on after which the whole duration is in both files
    where: str  # the flight's key, for complaints


class RecordedFlights:
    """A source of motion: `true` and `vio` are the poses of this tick, `step` goes on to the next."""

    def __init__(
        self, flights: tuple[Flight, ...], flights_dir: str | None, fleet: Fleet, random_window: bool = False
    ) -> None:
        """
        Args:
            random_window: every flight begins anywhere from its from_s on, whatever the others do, as the fleet's seed
                says; but so that no two MAVs begin too close to each other.

        Raises:
            BadExperiment: not one flight per MAV, or files that are missing, malformed or too short; or every random
                window brings MAVs too close.
        """
        if len(flights) != fleet.mavs:
            raise BadExperiment(f"world.flights: {len(flights)} flights, expected {fleet.mavs}, one per MAV")
        if flights_dir is None:
            raise BadExperiment(
                "world.flights_dir: where are the recorded flights? give it with --set world.flights_dir=DIR"
            )
        ticks_s = np.array([fleet.stamp_ns(tick) for tick in range(fleet.ticks)]) / 1e9
        duration_s = float(ticks_s[-1])
        recordings = [
            _open(flight, Path(flights_dir), f"world.flights[{k}]", duration_s) for k, flight in enumerate(flights)
        ]
        starts_s = (
            _random_starts(recordings, duration_s, fleet.seed)
            if random_window
            else [float(recording.start_s[0]) for recording in recordings]
        )
        played = [_play(recording, start_s + ticks_s) for recording, start_s in zip(recordings, starts_s, strict=True)]
        self._true = _together([true for true, _ in played])
        self._vio = _together([vio for _, vio in played])
        self._tick = 0
        self.contacts: set[tuple[int, int]] = set()  # nobody recorded any
        self.pose_world_odom = compose(self.true.level, inverse(self.vio.level))  # (N, 4), as true as at tick 0

    @property
    def true(self) -> Poses:
        return Poses(self._true.position[self._tick], self._true.quaternion[self._tick])

    @property
    def vio(self) -> Poses:
        """In each MAV's odometry frame."""
        return Poses(self._vio.position[self._tick], self._vio.quaternion[self._tick])

    def begin_odometry(self, mav: int) -> None:
        """A VIO that begins anew here goes on as the recorded one does, from zero and no yaw."""
        i, rest = mav - 1, slice(self._tick, None)
        begin = self.vio.level[i]
        position, quaternion = self._vio.position[rest, i], self._vio.quaternion[rest, i]
        self._vio.position[rest, i] = rotate_z(-begin[3], position - begin[:3])
        self._vio.quaternion[rest, i] = turn_z(np.full(len(position), -begin[3]), quaternion)

    def command(self, setpoints: Iterable[messages.Setpoint]) -> None:
        """They fly as they did, whatever is commanded."""

    def step(self) -> None:
        self._tick += 1


def body_rotation(truth: Track) -> Array:
    """(4,) quaternion of a MAV's body in the body that was recorded.

    The recorded body may be an IMU mounted in any way (EuRoC's has x up, which makes yaw singular). Our z axis is where
    up is in it on average over the file; our x axis is the first of its x, z and y that is not within 45 deg of that,
    made level. A body that is z up and hovers level is left as it is; EuRoC's gets its cameras' way of looking as x.
    """
    up = rotation_matrix(truth.poses.quaternion)[:, 2].mean(axis=0)
    up /= np.linalg.norm(up)
    ahead = next(axis for axis in np.eye(3)[[0, 2, 1]] if abs(axis @ up) < np.sqrt(0.5) + 1e-9)
    x = ahead - (ahead @ up) * up
    x /= np.linalg.norm(x)
    return quaternion_of(np.stack([x, np.cross(up, x), up], axis=-1))


def _open(flight: Flight, folder: Path, where: str, duration_s: float) -> Recording:
    truth = read_track(folder / flight.truth, where)
    vio = without_placeholders(read_track(folder / flight.vio, where))
    if not (len(truth.time_s) and len(vio.time_s)):
        raise BadExperiment(f"{where}: {flight.truth} or {flight.vio} holds no poses")
    begin = max(truth.time_s[0], vio.time_s[0]) + flight.from_s
    end = min(truth.time_s[-1], vio.time_s[-1])
    start_s = vio.time_s[(vio.time_s >= begin) & (vio.time_s + duration_s <= end + 1e-6)]
    if flight.from_s < 0 or not len(start_s):
        raise BadExperiment(
            f"{where}: {duration_s:g} s from from_s = {flight.from_s:g} on are asked for, but {flight.truth} and "
            f"{flight.vio} have {max(end - begin + flight.from_s, 0):.1f} s in common"
        )
    return Recording(truth, vio, start_s, where)


def _random_starts(recordings: list[Recording], duration_s: float, seed: int) -> list[float]:
    """When each flight begins, in its own time: at any VIO row that will do, all alike."""
    choices = [_gapless_starts(recording, duration_s) for recording in recordings]
    places = [
        poses_at(each.truth, start_s, each.where).position for each, start_s in zip(recordings, choices, strict=True)
    ]
    random = generator(seed, "random_window")
    rows = drawn_until(
        lambda rows: are_apart(np.array([place[row] for place, row in zip(places, rows, strict=True)])),
        lambda: [int(random.integers(len(start_s))) for start_s in choices],
        f"world.random_window = true: some MAVs are always closer than {CLEARANCE_M:g} m at the start, expected "
        "flights that are further apart",
    )
    return [float(start_s[row]) for start_s, row in zip(choices, rows, strict=True)]


def _gapless_starts(recording: Recording, duration_s: float) -> Array:
    """(K,) those starts after which no gap is too long to be bridged."""
    start_s = recording.start_s
    for time_s in (recording.truth.time_s, recording.vio.time_s):
        for k in np.flatnonzero(np.diff(time_s) > MAX_GAP_S):
            start_s = start_s[(start_s > time_s[k + 1]) | (start_s + duration_s <= time_s[k])]
    if not len(start_s):
        raise BadExperiment(
            f"{recording.where}: nowhere are there {duration_s:g} s without a gap of more than {MAX_GAP_S:g} s, "
            "expected longer recordings or a shorter fleet.duration_s"
        )
    return start_s


def _play(recording: Recording, at_s: Array) -> tuple[Poses, Poses]:
    """True and VIO poses at these times."""
    turn = body_rotation(recording.truth)
    true, read = (poses_at(track, at_s, recording.where) for track in (recording.truth, recording.vio))
    return Poses(true.position, multiply(true.quaternion, turn)), Poses(read.position, multiply(read.quaternion, turn))


def _together(poses: list[Poses]) -> Poses:
    """(T, N, ...) from N times (T, ...)."""
    position = np.stack([each.position for each in poses], axis=1)
    return Poses(position, np.stack([each.quaternion for each in poses], axis=1))
