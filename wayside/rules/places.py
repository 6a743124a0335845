"""The places of a Detector and the positions of its streams: compiled for rules, and checked."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

from wayside.api import Detector, EventRule
from wayside.api.documents import FieldPath
from wayside.api.eventrule import EventRuleSpec, Signal
from wayside.api.place import CoordinateFrame, Place
from wayside.api.stream import Stream
from wayside.expressions.expanding import SEEN_FROM, NamedPlaces
from wayside.geo.geometry import FARTHEST, Point, Shape, crossing, interned
from wayside.rules.problems import RuleProblem

_MOTION: Final = {False: ("yaw", "speed"), True: ("heading", "speed")}
"""The signals of both clients that `seenFrom` reads, in metres (False) and on the Earth (True)."""


class KnownPlaces(NamedTuple):
    """The places that rules can name."""

    shapes: Mapping[str, Shape]
    complete: bool = True
    """Whether all places are known; if not, any name is accepted."""


NO_MORE_IS_KNOWN: Final = KnownPlaces({}, complete=False)


def place_problems(detector: Detector) -> Iterator[RuleProblem]:
    """The problems of the places that the Detector itself defines."""
    for index, place in enumerate(detector.spec.places):
        for field, text in shape_problems(place.frame is CoordinateFrame.WGS84, place.area, place.line):
            yield RuleProblem(("spec", "places", index, *field), text)


def shape_problems(
    geographic: bool, area: Sequence[Sequence[float]] | None, line: Sequence[Sequence[float]] | None
) -> Iterator[tuple[FieldPath, str]]:
    """The problems of an area and a line: the field and the message."""
    found = False
    for field, points in (("area", area), ("line", line)):
        for index, (u, v) in enumerate(map(_point, points or ())):
            if (problem := _out_of_range(geographic, u, v)) is not None:
                found = True
                yield (field, index), problem
    if found:
        return
    if area is not None and (crossed := crossing([*map(_point, area)])) is not None:
        one, other = crossed
        count = len(area)
        yield (
            ("area",),
            (
                f"the edge from corner {one} to {(one + 1) % count} crosses or touches the edge from {other} to "
                f"{(other + 1) % count}: list each corner once, in order along the outline"
            ),
        )
    if line is not None and all(_point(each) == _point(line[0]) for each in line):
        yield ("line",), "all points of the line are the same: give two or more different points"


def _out_of_range(geographic: bool, u: float, v: float) -> str | None:
    if not geographic:
        if math.isfinite(u) and math.isfinite(v) and max(abs(u), abs(v)) <= FARTHEST:
            return None
        return f"must be at most {FARTHEST:g} metres from the origin; got [{u:g}, {v:g}]"
    if abs(u) <= 90 and abs(v) <= 360:
        return None
    return f"must be [latitude, longitude] in degrees; got [{u:g}, {v:g}]: correct the order, or set frame: Metres"


def places_of(detector: Detector) -> Mapping[str, Shape]:
    """The valid places that the Detector itself defines, by name."""
    wrong = {problem.path[2] for problem in place_problems(detector)}
    return {place.name: shape_of_place(place) for at, place in enumerate(detector.spec.places) if at not in wrong}


def own_places(detector: Detector) -> KnownPlaces:
    """The places that rules can name if the Detector's maps are not read."""
    return KnownPlaces(places_of(detector), complete=not detector.spec.maps)


def shape_of_place(place: Place) -> Shape:
    """The geometry of a place without problems."""
    rings = () if place.area is None else (tuple(map(_point, place.area)),)
    line = tuple(map(_point, place.line or ()))
    return interned(Shape(place.name, place.frame is CoordinateFrame.WGS84, rings, line, place.width))


def _point(corner: Sequence[float]) -> Point:
    u, v = corner
    return float(u), float(v)


def located(rule: EventRule, detector: Detector) -> EventRule:
    """The rule, completed with the positions of its Detector.

    A position of pairs without axes gets those of its stream. A rule over pairs that uses `seenFrom` gets the signals
    that this function reads, yaw (on the Earth: heading) and speed, unless it has signals of these names.
    """
    pairs = rule.spec.scope.pairs
    stream = None if pairs is None else detector.spec.stream(pairs.position.stream)
    if pairs is None or stream is None or stream.position is None:
        return rule
    position, own = pairs.position, stream.position
    if position.x is None and position.latitude is None:
        names = ("latitude", "longitude") if own.geographic else ("x", "y", "z")
        axes = {axis: source for axis, source in own.axes.items() if axis in names}
        pairs = pairs.model_copy(update={"position": position.model_copy(update=axes)})
    signals = list(rule.spec.signals)
    if SEEN_FROM in _conditions(rule.spec):
        named = {signal.name for signal in signals}
        for axis in _MOTION[pairs.position.latitude is not None]:
            if axis in own.axes and axis not in named:
                signals.append(Signal(name=axis, stream=stream.name, value=own.axes[axis]))
    scope = rule.spec.scope.model_copy(update={"pairs": pairs})
    return rule.model_copy(update={"spec": rule.spec.model_copy(update={"scope": scope, "signals": signals})})


def _conditions(spec: EventRuleSpec) -> str:
    """All expressions about pairs in one text."""
    where = None if spec.scope.pairs is None else spec.scope.pairs.where
    of = [signal.of for signal in spec.signals]
    return f"{where} {spec.when} {spec.until} {of} {[action.to_json() for action in spec.actions]}"


def of_conditions(rule: EventRule, known: KnownPlaces) -> NamedPlaces:
    """The places and positions that the rule's conditions can use."""
    pairs = rule.spec.scope.pairs
    return NamedPlaces(known.shapes, known.complete, None if pairs is None else pairs.position.latitude is not None)


def of_samples(stream: Stream | None, known: KnownPlaces) -> NamedPlaces:
    """The places and positions that an expression over a sample can use; `stream` is None for an episode start."""
    if stream is None:
        return NamedPlaces(known.shapes, known.complete)
    axes = {} if stream.position is None else stream.position.axes
    own = "msg" if stream.items is None else "item"
    return NamedPlaces(known.shapes, known.complete, None, axes, stream.name, own)
