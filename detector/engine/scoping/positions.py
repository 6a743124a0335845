"""The positions of clients: from the newest sample of a stream, in metres of one frame or on the Earth."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from detector.engine.buffering.buffer import Buffer
from detector.engine.buffering.clients import is_fresh
from detector.engine.buffering.messages import Messages
from detector.engine.buffering.naming import PossibleStreams
from detector.engine.counters import RuleCounters
from detector.engine.samples.sample import Sample
from wayside.expressions import UNKNOWN, Expression, Unknown, Value
from wayside.geo import geodesy
from wayside.rules import CompiledPosition

Place = tuple[float, ...]
"""Metres (x, y, z); or degrees (latitude, longitude)."""

Point = tuple[float, float, float]
"""Metres in a straight frame: the input of a search."""

FARTHEST = 1e12
"""Maximum coordinate in metres; from 1e154 on, the squares of distances overflow."""

LIMITS: Mapping[str, float] = {"latitude": 90.0, "longitude": 360.0}
"""Degrees; some sources write longitudes from 0 to 360."""


class PositionLookup:
    """Looks up positions in the buffer."""

    def __init__(
        self,
        buffer: Buffer,
        messages: Messages,
        stale_after: Mapping[str, int | None],
        possible: PossibleStreams,
        floor: int | None,
    ) -> None:
        """`floor`: samples up to this time are ignored, in nanoseconds.

        A client that can never have a position (see `possible`) is not counted as one with an unknown position.
        """
        self._buffer = buffer
        self._messages = messages
        self._stale_after = stale_after
        self._possible = possible
        self._floor = floor

    def gap(self, time: int) -> None:
        """Samples before `time` give no positions any more."""
        self._floor = time

    def now(self, position: CompiledPosition, client: str, now: int, counters: RuleCounters) -> Place | None:
        """The client's place from its newest sample; None if it is unknown or invalid."""
        lane = self._buffer.lane(client, position.stream)
        sample = None if lane is None else lane.newest
        if sample is None or not is_fresh(client, position.stream, self.limit(position), self._buffer, now):
            counters.unknowns += self._possible(position.stream, client)
            return None
        if counters.ages is not None and lane is not None:
            counters.ages.used(lane, now)
        return self._place(position, client, sample, counters)

    def common_time(self, position: CompiledPosition, clients: Iterable[str], now: int) -> int:
        """The newest time at which the positions of all these clients are known, in nanoseconds.

        This is `now` for positions without a maximum age: the last one stays valid. All clients have a place now.
        """
        if self.limit(position) is None:
            return now
        lanes = (self._buffer.lane(client, position.stream) for client in clients)
        return min(lane.newest.time for lane in lanes if lane is not None and lane.newest is not None)

    def sample(self, position: CompiledPosition, client: str, then: int, now: int) -> Sample | None:
        """The newest sample up to a past time; None if there is none, or if it was too old then."""
        lane, limit = self._buffer.lane(client, position.stream), self.limit(position)
        sample = None if lane is None else next(lane.newest_first(self._floor, then, now), None)
        return None if sample is None or (limit is not None and then - sample.time > limit) else sample

    def of(
        self, position: CompiledPosition, client: str, sample: Sample | None, counters: RuleCounters
    ) -> Place | None:
        """The client's place in a sample; None as in `now`."""
        if sample is None:
            counters.unknowns += 1
            return None
        return self._place(position, client, sample, counters)

    def limit(self, position: CompiledPosition) -> int | None:
        """The maximum age of samples for a known position, in nanoseconds; None: unlimited."""
        stale, oldest = self._stale_after[position.stream], position.max_age_ns
        return oldest if stale is None or (oldest is not None and oldest < stale) else stale

    def _place(self, position: CompiledPosition, client: str, sample: Sample, counters: RuleCounters) -> Place | None:
        place = []
        for axis, expression in position.axes.items():
            value = self._evaluate(axis, expression, position, client, sample, counters)
            if not isinstance(value, int | float):
                counters.misplace(f"{axis} of {client} is absent, NaN, not a number, or cannot be read")
                return None
            if not abs(value) <= LIMITS.get(axis, FARTHEST):
                counters.unknowns += 1
                unit = "degrees" if position.geographic else "m"
                counters.misplace(f"{axis} of {client} is {value:g} {unit}, which is not on the Earth")
                return None
            place.append(float(value))
        return tuple(place)

    def _evaluate(
        self,
        axis: str,
        expression: Expression,
        position: CompiledPosition,
        client: str,
        sample: Sample,
        counters: RuleCounters,
    ) -> Value | Unknown:
        parameters = position.parameters.of(client)
        values = self._messages.values(position.stream, sample, expression.names, parameters)
        if values is None:
            counters.unknowns += 1
            return UNKNOWN
        place = f"{axis} of {client}, stream {position.stream}"
        return expression.evaluate_or_unknown(values, lambda reason, message: counters.note(reason, message, place))


def described(position: CompiledPosition, place: Place) -> dict[str, float]:
    """The members of a place in expressions: x, y and z in metres, or latitude and longitude in degrees."""
    found = dict(zip(position.axes, place, strict=True))
    if not position.geographic:
        found.setdefault("z", 0.0)
    return found


def distance(position: CompiledPosition, one: Place, other: Place) -> float:
    """Metres: straight in a flat frame, along the surface on the Earth.

    The result does not depend on the order of the two. In a flat frame it is √(dx² + dy² + dz²), rounded after each
    operation, so every computation in this order gives the same number.
    """
    if position.geographic:
        return geodesy.surface_distance(*min(one, other), *max(one, other))
    squares = 0.0
    for p, q in zip(one, other, strict=True):
        squares += (p - q) * (p - q)
    return math.sqrt(squares)


def distance_of_order_1(position: CompiledPosition, one: Place, other: Place) -> float:
    """The distance for detectors of order 1 (see `steps.ORDER`): it differs in the last digits."""
    return geodesy.surface_distance(*one, *other) if position.geographic else math.dist(one, other)


def point(position: CompiledPosition, place: Place) -> Point:
    """The place in the form that a search takes: no two points are farther apart than `distance`."""
    if position.geographic:
        return geodesy.cartesian(*place)
    x, y, *rest = place
    return (x, y, rest[0] if rest else 0.0)
