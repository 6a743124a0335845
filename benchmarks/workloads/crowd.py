"""A crowd in a square: each client walks at random and reports its position once a second."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence

from detector.engine.samples.sample import Arrival
from wayside.api import Detector, EventRule

START = 1_700_000_000_000_000_000
"""Nanoseconds since the epoch; a whole multiple of a second."""

TICK = 1_000_000_000
"""The rule's period, and that of the samples, in nanoseconds."""

WITHIN, BELOW, ABOVE = 30.0, 10.0, 15.0
"""Metres: pairs within reach are looked at, an episode starts below one distance and ends above another."""

NEIGHBOURS = 3.0
"""How many clients are within reach of one on average."""

STEP = 3.0
"""Standard deviation of a step along each axis, in metres."""

MAX_PAIRS = 1_000_000


def side(clients: int) -> float:
    """Of the square, in metres."""
    return round(math.sqrt(clients * math.pi * WITHIN**2 / NEIGHBOURS), 3)


def detector() -> Detector:
    """A Detector with one stream of JSON."""
    stream = {"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "json", "buffer": {"duration": "5s"}}
    return Detector.model_validate(
        {
            "kind": "Detector",
            "metadata": {"name": "crowd"},
            "spec": {"streams": [stream], "buffer": {"bytes": "10Gi"}},
        }
    )


def rule() -> EventRule:
    """Two clients near each other, evaluated once a second."""
    pairs = {"position": {"stream": "pose", "x": "msg.x", "y": "msg.y"}, "within": WITHIN, "maxPairs": MAX_PAIRS}
    spec = {"evaluation": {"every": "1s"}, "scope": {"pairs": pairs}}
    conditions = {"when": f"distance < {BELOW}", "until": f"distance > {ABOVE}"}
    return EventRule.model_validate({"kind": "EventRule", "metadata": {"name": "near"}, "spec": spec | conditions})


def parts(clients: int, ticks: int) -> Iterator[tuple[int, Sequence[Arrival]]]:
    """Each tick and what arrived since the last one: a sample of each client, the last exactly at the tick."""
    walk = random.Random(clients)
    length = side(clients)
    keys = [f"vehicles/c{client}/pose" for client in range(clients)]
    places = [(walk.uniform(0, length), walk.uniform(0, length)) for _ in keys]
    shift = (TICK - 1_000_000) // clients
    for number in range(ticks):
        tick = START + (number + 1) * TICK
        first = tick - (clients - 1) * shift
        yield (
            tick,
            [
                Arrival(first + client * shift, "pose", key, b'{"x": %.3f, "y": %.3f}' % places[client])
                for client, key in enumerate(keys)
            ],
        )
        places = [(inside(x + walk.gauss(0, STEP), length), inside(y + walk.gauss(0, STEP), length)) for x, y in places]


def inside(coordinate: float, length: float) -> float:
    """The coordinate, reflected at the edges of the square."""
    coordinate = abs(coordinate)
    return coordinate if coordinate < length else 2 * length - coordinate - 0.001
