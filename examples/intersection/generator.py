"""A minute at an intersection, generated from a seed: what every road user sends, ten times a second.

Roads cross at (0, 0); x is east, y is north, in metres. Eastbound traffic has two lanes (y = -2 and -5.5), westbound
one (y = 2), northbound x = 2, southbound x = -2. A road user follows a path at given speeds, with noise of the seed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Points = Sequence[tuple[float, float]]

SEED = 18
STEP_S = 0.1
SECONDS = 60
START_NS = 1_767_225_600_000_000_000


@dataclass(frozen=True)
class RoadUser:
    """Who drives along a path: speeds (m/s) by time (s), linear between; it sends from the first to the last time."""

    name: str
    path: Points
    speeds: Points
    silent: tuple[float, float] | None = None
    """Between these times it sends every fifth sample only."""
    jump: tuple[float, float] | None = None
    """Between these times its positions are 12 m beside the path."""


ROAD_USERS = (
    # Eastbound on the inner lane, across a red light; car-2 cuts in from the outer lane before it.
    RoadUser("car-1", [(-100, -2), (200, -2)], [(0, 10), (20, 10)]),
    RoadUser("car-2", [(-92, -5.5), (-52, -5.5), (-30, -2), (200, -2)], [(0, 10), (20, 10)]),
    # A truck on the outer lane, which car-3 overtakes; car-4 comes towards it the wrong way and turns off late.
    RoadUser("truck-1", [(-60, -5.5), (200, -5.5)], [(20, 6), (50, 6)]),
    RoadUser("car-3", [(-100, -2), (200, -2)], [(20, 15), (36, 15)]),
    RoadUser("car-4", [(90, -5.5), (5, -5.5), (2, -30)], [(15, 6), (34, 6)]),
    # Southbound: brakes hard and stands on the crossing.
    RoadUser("car-5", [(-2, 60), (-2, -60)], [(10, 12), (14, 12), (15.5, 0), (57, 0)]),
    # Northbound just behind car-1: a short time between the two at the same place.
    RoadUser("car-6", [(2, -60), (2, 60)], [(5.6, 10), (17, 10)]),
    # Falls silent on the crossing.
    RoadUser("car-7", [(2, -40), (2, 60)], [(32, 5), (39.4, 5)]),
    # Westbound: its position jumps, and later it sends less often.
    RoadUser("car-8", [(150, 2), (-200, 2)], [(22, 5), (58, 5)], silent=(40, 46), jump=(25, 26)),
    # A queue before the red light, which leaves when the light is green.
    *(
        RoadUser(
            f"car-{11 + place}",
            [(-90 - 7.0 * place, -2), (200, -2)],
            [(32, 10), (38, 10), (42, 0), (50 + place, 0), (53 + place, 8), (60, 8)],
        )
        for place in range(4)
    ),
)

RED = ((8.8, 12.0), (38.0, 49.0))
"""When the light for eastbound traffic is red, in seconds."""


class Sent(NamedTuple):
    """The samples of a client on a stream."""

    client: str
    stream: str
    times: Doubles
    """Seconds; whole multiples of the step."""
    fields: dict[str, Any]
    """Of each field a value for each time."""


def sent(seed: int = SEED) -> list[Sent]:
    """All samples of the drive."""
    rng = np.random.default_rng(seed)
    light = _tenths(0.0, SECONDS - STEP_S)
    red = np.zeros(len(light), bool)
    for begin, end in RED:
        red |= (light >= begin) & (light < end)
    phase = np.where(red, "red", "green").tolist()
    return [*(_driven(each, rng) for each in ROAD_USERS), Sent("light-east", "phase", light, {"phase": phase})]


def messages(seed: int = SEED) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Time in nanoseconds, key and message, in order of time."""
    rows = [
        (START_NS + round(time * 10) * 100_000_000, f"intersection/{each.client}/{each.stream}", each, at)
        for each in sent(seed)
        for at, time in enumerate(each.times.tolist())
    ]
    for time, key, each, at in sorted(rows, key=lambda row: row[:2]):
        yield time, key, {name: values[at] for name, values in each.fields.items()}


def recording(seed: int = SEED) -> str:
    """All messages as JSON lines, which `detector replay` reads."""
    return "".join(json.dumps({"t": time, "key": key, "value": value}) + "\n" for time, key, value in messages(seed))


def _tenths(first: float, last: float) -> Doubles:
    """From the first to the last second, in steps."""
    return np.arange(round(first * 10), round(last * 10) + 1).astype(np.float64) / 10


def _driven(user: RoadUser, rng: np.random.Generator) -> Sent:
    times, speeds = np.array(user.speeds, float).T
    t = _tenths(float(times[0]), min(float(times[-1]), SECONDS - STEP_S))
    speed = np.interp(t, times, speeds)
    way = np.concatenate(([0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * STEP_S)))
    corners = np.array(user.path, float)
    legs = np.diff(corners, axis=0)
    lengths = np.hypot(*legs.T)
    begins = np.concatenate(([0.0], np.cumsum(lengths)))
    leg = np.minimum(np.searchsorted(begins, way, "right") - 1, len(legs) - 1)
    x, y = (np.interp(way, begins, axis) for axis in corners.T)
    yaw = np.arctan2(legs[leg, 1], legs[leg, 0])
    if user.jump is not None:
        y = np.where((t >= user.jump[0]) & (t < user.jump[1]), y + 12.0, y)
    noise = rng.normal(0, 0.02, (4, len(t)))
    fields = {
        "x": x + noise[0],
        "y": y + noise[1],
        "yaw": yaw + noise[2] / 10,
        "speed": np.maximum(speed + noise[3], 0),
    }
    kept = np.ones(len(t), bool)
    if user.silent is not None:
        kept = ~((t >= user.silent[0]) & (t < user.silent[1])) | (np.round(t * 10) % 5 == 0)
    return Sent(user.name, "state", t[kept], {name: np.round(each[kept], 3).tolist() for name, each in fields.items()})
