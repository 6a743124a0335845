"""Places and the frames of road users, by the documentation: exact fractions, one position at a time."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any

_FIELD = re.compile(r'(at|seenFrom)\((\w+(?:\.\w+)?), ("\w+"|\w+)\)\.(\w+)')
_POSITION = re.compile(r"(?<![\w.])position\.(\w+)")

Vector = tuple[Fraction, Fraction]


@dataclass(frozen=True)
class PlaceContext:
    """The known positions of road users, and the places that expressions name."""

    places: dict[str, dict[str, Any]]
    position: dict[str, str]
    """Of the samples of one stream: the names of the fields of msg, by axis."""


def with_fields(
    source: str, variables: dict[str, Any], where: PlaceContext
) -> tuple[str, dict[str, Any], tuple[str, ...]]:
    """The expression with a plain variable for each field of a place or of another road user; unknown ones are absent.

    Also the variables, and the names of those that were added.
    """
    found: dict[str, Any] = {}
    names: list[str] = []

    def named(value: Any) -> str:
        names.append(f"field{len(names)}")
        if value is not None:
            found[names[-1]] = value
        return names[-1]

    def field(match: re.Match[str]) -> str:
        function, one, other, name = match.groups()
        if function == "seenFrom":
            return named(_seen(variables.get(one, {}), variables.get(other, {}), name))
        return named(_at(_place(one, variables, where), where.places[other.strip('"')], name))

    text = _FIELD.sub(field, source)
    text = _POSITION.sub(lambda match: named(_place("position", variables, where).get(match[1])), text)
    return text, {**variables, **found}, tuple(names)


def located(spec: dict[str, Any], positions: dict[str, dict[str, str]]) -> dict[str, Any]:
    """The rule with the positions of streams written out, and the signals that `seenFrom` reads."""
    pairs = spec.get("scope", {}).get("pairs")
    if pairs is None or pairs["position"]["stream"] not in positions:
        return spec
    own = positions[pairs["position"]["stream"]]
    position = {"x": own["x"], "y": own["y"], **pairs["position"]}
    signals = list(spec.get("signals", []))
    if "seenFrom" in f"{spec['when']} {spec.get('until')} {[each.get('of') for each in spec['signals']]}":
        signals += [
            {"name": name, "stream": position["stream"], "value": own[name]} for name in ("yaw", "speed")
        ]  # fmt: skip
    return {**spec, "scope": {"pairs": {**pairs, "position": position}}, "signals": signals}


def _place(name: str, variables: dict[str, Any], where: PlaceContext) -> dict[str, float]:
    """The position that an expression names, without unknown values."""
    if name in ("position", "positionBefore"):
        message = variables.get("msg" if name == "position" else "before") or {}
        given = {axis: message.get(field.removeprefix("msg.")) for axis, field in where.position.items()}
    else:
        client, _, _ = name.partition(".")
        given = variables.get(client, {}).get("position", {})
    return {axis: value for axis, value in given.items() if isinstance(value, float) and math.isfinite(value)}


def _at(position: dict[str, float], place: dict[str, Any], name: str) -> Any:
    if not position.keys() >= {"x", "y"} or (name == "heading" and "yaw" not in position):
        return None
    at = Fraction(position["x"]), Fraction(position["y"])
    if "area" in place:
        corners = [_exact(each) for each in place["area"]]
        outline = [*zip(corners, [*corners[1:], corners[0]], strict=True)]
        inside = _inside(at, outline)
        return inside if name == "inside" else 0.0 if inside else min(_to_segment(at, *each) for each in outline)
    points = [_exact(each) for each in place["line"]]
    segments = [*pairwise(points)]
    along, across, nearest = _arc(at, segments)
    if name == "heading":
        (ax, ay), (bx, by) = segments[nearest]
        return _turn(math.degrees(math.atan2(by - ay, bx - ax)), math.degrees(position["yaw"]))
    if name in ("along", "across"):
        return {"along": along, "across": across}[name]
    if "width" not in place:
        return min(_to_segment(at, *each) for each in segments)
    length = sum(math.dist(*each) for each in segments)
    aside, beyond = max(0.0, abs(across) - place["width"] / 2), max(0.0, -along, along - length)
    return aside == beyond == 0 if name == "inside" else math.hypot(aside, beyond)


def _seen(a: dict[str, Any], b: dict[str, Any], name: str) -> float | None:
    """`b` turned into the frame of `a`; None if a required value is unknown."""
    motion = [each.get(axis) for each in (a, b) for axis in ("yaw", "speed")]
    places = [each.get("position", {}).get(axis) for each in (a, b) for axis in ("x", "y")]
    needed = {"ahead": [*places, motion[0]], "left": [*places, motion[0]], "heading": [motion[0], motion[2]]}
    if not all(isinstance(each, float) for each in needed.get(name, motion)):
        return None
    turn = complex(math.cos(motion[0]), -math.sin(motion[0]))
    if name in ("ahead", "left"):
        relative = complex(places[2] - places[0], places[3] - places[1]) * turn
        return relative.real if name == "ahead" else relative.imag
    if name == "heading":
        return _turn(math.degrees(motion[0]), math.degrees(motion[2]))
    velocity = complex(math.cos(motion[2]), math.sin(motion[2])) * motion[3] * turn - motion[1]
    return velocity.real if name == "speedAhead" else velocity.imag


def _arc(at: Vector, segments: list[tuple[Vector, Vector]]) -> tuple[float, float, int]:
    """Along, across and the nearest segment; the first and the last extend beyond the ends of the line."""
    distances = [_to_segment(at, *each) for each in segments]
    nearest = distances.index(min(distances))
    part, cross = _part(at, *segments[nearest])
    before = sum(math.dist(*each) for each in segments[:nearest])
    length = math.dist(*segments[nearest])
    on = min(max(part, 0), 1)
    beyond = (nearest == 0 and part < 0) or (nearest == len(segments) - 1 and part > 1)
    if part == on or beyond:
        return before + float(part) * length, float(cross) / length, nearest
    # At a corner: left is where both segments turn their left side, and one suffices behind a turn to the right.
    beside = nearest + (1 if part > 1 else -1)
    _, other = _part(at, *segments[beside])
    return before + float(on) * length, math.copysign(distances[nearest], cross + other), nearest


def _part(at: Vector, a: Vector, b: Vector) -> tuple[Fraction, Fraction]:
    """How far along the way from a to b, as a part of it, and the cross product."""
    (dx, dy), (px, py) = (b[0] - a[0], b[1] - a[1]), (at[0] - a[0], at[1] - a[1])
    return (px * dx + py * dy) / (dx * dx + dy * dy), dx * py - dy * px


def _to_segment(at: Vector, a: Vector, b: Vector) -> float:
    part = min(max(_part(at, a, b)[0], Fraction(0)), Fraction(1))
    x, y = a[0] + part * (b[0] - a[0]) - at[0], a[1] + part * (b[1] - a[1]) - at[1]
    return math.sqrt(x * x + y * y)


def _inside(at: Vector, outline: list[tuple[Vector, Vector]]) -> bool:
    if any(_to_segment(at, *each) == 0 for each in outline):
        return True
    crossed = 0
    for (ax, ay), (bx, by) in outline:
        if (ay > at[1]) != (by > at[1]):
            crossed += ax + (at[1] - ay) / (by - ay) * (bx - ax) > at[0]
    return crossed % 2 == 1


def _turn(start: float, end: float) -> float:
    by = (end - start) % 360
    return by - 360 if by > 180 else by


def _exact(point: Iterable[float]) -> Vector:
    x, y = map(Fraction, point)
    return x, y
