"""Fifteen vehicles that drive routes through the network: the same seed gives the same drive.

Two shuttles circle the old town on the ring, one each way; four taxis and nine cars wander. Shuttles and taxis carry a
lidar. The seed sets where everybody starts, how briskly they drive and which way they turn. They keep to their lane,
to the speed of each segment and to gentle accelerations, and take no notice of each other.

A vehicle's place is a pure function of time: `simulate(seed).pose("taxi_1", 3.2)`.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cooperative_recording.network import RING, Floats, Lane, Segment, choices, connection, lanes

ACCELERATION = 2.5
"""The lengthwise acceleration and deceleration in m/s² that nobody exceeds."""
STRAIGHT_ON = 3.0
"""How much likelier one goes straight on at a junction than into any one other road."""
FASTEST = 28.0
"""No segment is driven faster than this, in m/s."""
LOOKAHEAD = FASTEST**2 / (2 * ACCELERATION)
"""How far ahead, in metres, one may have to brake: routes are known this much beyond their horizon."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A connected vehicle. Its name is valid in ROS topics."""

    name: str
    lidar: bool = False


SHUTTLES = (Vehicle("shuttle_1", lidar=True), Vehicle("shuttle_2", lidar=True))
TAXIS = tuple(Vehicle(f"taxi_{number}", lidar=True) for number in range(1, 5))
CARS = tuple(Vehicle(f"car_{number}") for number in range(1, 10))
VEHICLES: tuple[Vehicle, ...] = (*SHUTTLES, *TAXIS, *CARS)
LIDAR_VEHICLES: tuple[Vehicle, ...] = tuple(vehicle for vehicle in VEHICLES if vehicle.lidar)


@dataclass(frozen=True, slots=True)
class Pose:
    """Where a vehicle is: metres in the frame "map", and the heading in radians from east, counterclockwise."""

    x: float
    y: float
    z: float
    yaw: float


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One vehicle's drive, with constant acceleration from point to point.

    At times[i] seconds it is at points[i] (x, y in metres, yaw in radians, unwrapped) with speeds[i] (m/s).
    """

    times: Floats
    speeds: Floats
    points: Floats

    def at(self, times: Floats) -> Floats:
        """x, y and unwrapped yaw at each of the times (s, within the track's), shape (n, 3)."""
        here = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.times) - 2)
        elapsed, lasting = times - self.times[here], self.times[here + 1] - self.times[here]
        before, after = self.speeds[here], self.speeds[here + 1]
        driven = before * elapsed + (after - before) * elapsed**2 / (2 * lasting)
        share = (driven / ((before + after) / 2 * lasting))[:, None]
        return (1 - share) * self.points[here] + share * self.points[here + 1]


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """The drive of all vehicles from second 0 to the horizon."""

    seed: int
    horizon_s: float
    tracks: dict[str, Track]

    def pose(self, vehicle: str, t: float) -> Pose:
        """Where the vehicle is t seconds into the drive.

        Raises:
            KeyError: no vehicle has that name.
            ValueError: t lies outside the drive.
        """
        x, y, yaw = self.poses(vehicle, np.array([t]))[0].tolist()
        return Pose(x, y, 0.0, yaw)

    def poses(self, vehicle: str, times: Floats) -> Floats:
        """x, y and yaw (m, m, rad in -π..π) of the vehicle at each of the times (s), shape (n, 3).

        Raises:
            KeyError: no vehicle has that name.
            ValueError: a time lies outside the drive.
        """
        if times.size and (times.min() < 0 or times.max() > self.horizon_s):
            raise ValueError(
                f"t: {times.min():g}..{times.max():g} s is not within the drive's 0..{self.horizon_s:g} s: "
                "simulate with a longer horizon_s"
            )
        poses = self.tracks[vehicle].at(times)
        poses[:, 2] = np.remainder(poses[:, 2] + np.pi, 2 * np.pi) - np.pi
        return poses


def simulate(seed: int, horizon_s: float = 60.0) -> Drive:
    """The drive of that seed; a longer horizon only adds to its end."""
    tracks = {}
    for number, vehicle in enumerate(VEHICLES):
        rng = np.random.default_rng([seed, number])
        briskness = rng.uniform(0.92, 1.0)
        way = _circle(rng, clockwise=number == 0) if vehicle in SHUTTLES else _wander(rng)
        start = rng.uniform(0.0, 1.0)
        tracks[vehicle.name] = _track(way, start, briskness, horizon_s)
    return Drive(seed, horizon_s, tracks)


def _circle(rng: np.random.Generator, *, clockwise: bool) -> Iterator[Lane]:
    around = RING if clockwise else RING[::-1]
    first = int(rng.integers(len(around)))
    corners = itertools.cycle(around[first:] + around[:first])
    return itertools.pairwise(corners)


def _wander(rng: np.random.Generator) -> Iterator[Lane]:
    every = sorted(lanes())
    lengths = np.array([lanes()[lane].length for lane in every])
    return _walk(every[int(rng.choice(len(every), p=lengths / lengths.sum()))], int(rng.integers(2**63)))


def _walk(lane: Lane, seed: int) -> Iterator[Lane]:
    rng = np.random.default_rng(seed)
    while True:
        yield lane
        onward = choices(lane)
        weights = np.array([STRAIGHT_ON if straight else 1.0 for _, straight in onward])
        lane = onward[int(rng.choice(len(onward), p=weights / weights.sum()))][0]


def _track(way: Iterator[Lane], start: float, briskness: float, horizon_s: float) -> Track:
    """Drive along the lanes from `start` (a share of the first one) until the horizon."""
    lane = next(way)
    first = lanes()[lane]
    skipped = round(start * 0.8 * (len(first.points) - 1))
    segments = [Segment(first.points[skipped:], first.speed)]
    length = segments[0].length
    while length < FASTEST * horizon_s + LOOKAHEAD:
        follower = next(way)
        segments += [connection(lane, follower), lanes()[follower]]
        length += segments[-1].length
        lane = follower
    points = np.vstack([segments[0].points, *(segment.points[1:] for segment in segments[1:])])
    steps = np.hypot(*np.diff(points, axis=0).T)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    limits = np.concatenate(
        [np.full(len(s.points) - (number > 0), s.speed * briskness) for number, s in enumerate(segments)]
    )
    speeds = _speeds(travelled, limits)
    times = np.concatenate([[0.0], np.cumsum(2 * steps / (speeds[:-1] + speeds[1:]))])
    headings = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
    yaws = np.concatenate([headings[:1], (headings[:-1] + headings[1:]) / 2, headings[-1:]])
    return Track(times, speeds, np.column_stack([points, yaws]))


def _speeds(travelled: Floats, limits: Floats) -> Floats:
    """The fastest speeds within the limits and the acceleration.

    v² changes by 2a per metre, so it is the lower envelope of cones of that slope over the squared limits: one running
    minimum forwards, one backwards.
    """
    slope = 2 * ACCELERATION * travelled
    squares = np.minimum.accumulate(limits**2 - slope) + slope
    squares = np.minimum.accumulate((squares + slope)[::-1])[::-1] - slope
    return np.sqrt(squares)
