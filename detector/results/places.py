"""The places that rules name: the Detector's, and polygons among the rules' parameters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from wayside.rules import CompiledRule


class Polygon(NamedTuple):
    """An area or a line."""

    rule: str
    name: str
    """The name of the place or parameter, or of the element and the field."""
    corners: tuple[tuple[float, float], ...]
    """x and y in metres, or latitude and longitude in degrees."""
    geographic: bool
    closed: bool = True
    """Whether it is an area; otherwise it is a line."""


def polygons_of(rules: Iterable[CompiledRule]) -> Iterator[Polygon]:
    """The places that rules name, each once, and the areas among their parameters and elements."""
    named_already: set[str] = set()
    for rule in rules:
        for place in rule.places:
            if place.key not in named_already:
                named_already.add(place.key)
                for ring in place.rings:
                    yield Polygon(rule.name, place.name, ring, place.geographic)
                if place.line:
                    yield Polygon(rule.name, place.name, place.line, place.geographic, closed=False)
        named: dict[str, Any] = dict(rule.parameters.own)
        for element in rule.elements:
            for variable in element.variables.values():
                if isinstance(variable, Mapping):
                    named |= {f"{element.name} {key}": value for key, value in variable.items()}
        read = rule.when.source + (rule.until.source if rule.until is not None else "")
        read += "".join(signal.value.source for signal in rule.signals if signal.value is not None)
        for name, value in named.items():
            corners = _corners(value)
            if corners is not None:
                yield Polygon(rule.name, name, corners, "insideWgs84" in read)


def _corners(value: Any) -> tuple[tuple[float, float], ...] | None:
    if not isinstance(value, list) or len(value) < 3:
        return None
    found = []
    for each in value:
        pair = [each.get("x"), each.get("y")] if isinstance(each, Mapping) else each
        if not isinstance(pair, list) or len(pair) != 2 or not all(isinstance(axis, int | float) for axis in pair):
            return None
        found.append((float(pair[0]), float(pair[1])))
    return tuple(found)
