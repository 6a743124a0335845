"""Constraints in PER's form: several ranges are replaced by the one that spans them (X.691 10.3.21).

asn1tools uses only the first range: `(unknown | passengerCar..tram)` would be one number without any bit. So the parsed
modules are simplified before asn1tools resolves them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_MARKER = None
"""How asn1tools represents `...`."""


def span_constraints(trees: Mapping[str, Any]) -> None:
    """Replaces constraints of several ranges by one, in modules parsed by asn1tools."""
    for tree in trees.values():
        _visit(tree["types"], trees)


def _visit(node: Any, trees: Mapping[str, Any]) -> None:
    if isinstance(node, dict):
        for name in ("restricted-to", "size"):
            ranges = node.get(name)
            if isinstance(ranges, list) and len(_root(ranges)) > 1:
                spanned = _span(_root(ranges), node, trees)
                if spanned is not None:
                    node[name] = [spanned, _MARKER] if _MARKER in ranges else [spanned]
        for value in node.values():
            _visit(value, trees)
    elif isinstance(node, list):
        for value in node:
            _visit(value, trees)


def _root(ranges: list[Any]) -> list[Any]:
    """The part before the extension marker."""
    return ranges[: ranges.index(_MARKER)] if _MARKER in ranges else ranges


def _span(ranges: list[Any], node: Mapping[str, Any], trees: Mapping[str, Any]) -> tuple[int, int] | None:
    """From the lowest to the highest; None if a bound is unknown, which asn1tools reports."""
    ends = [end for each in ranges for end in (each if isinstance(each, tuple) else (each,))]
    numbers = [_number(end, node, trees) for end in ends]
    known = [number for number in numbers if number is not None]
    return (min(known), max(known)) if len(known) == len(numbers) else None


def _number(end: Any, node: Mapping[str, Any], trees: Mapping[str, Any]) -> int | None:
    if isinstance(end, int):
        return end
    if not isinstance(end, str):
        return None
    if end.lstrip("-").isdigit():
        return int(end)
    named = named_numbers(aliases(str(node.get("type", "")), trees), trees) | dict(node.get("named-numbers", {}))
    return named[end] if end in named else named_number(end, trees)


def type_tree(name: str, trees: Mapping[str, Any]) -> Mapping[str, Any]:
    """The definition of the type, in any of the modules; empty if there is none."""
    return next((tree["types"][name] for tree in trees.values() if name in tree["types"]), {})


def aliases(name: str, trees: Mapping[str, Any]) -> list[str]:
    """The name of the type, and its aliases."""
    names: list[str] = []
    while name and name not in names:
        names.append(name)
        name = str(type_tree(name, trees).get("type", ""))
    return names


def named_numbers(names: list[str], trees: Mapping[str, Any]) -> dict[str, int]:
    """The named numbers of the first of these INTEGER types that has any."""
    found = (type_tree(name, trees) for name in names)
    return next((dict(tree["named-numbers"]) for tree in found if "named-numbers" in tree), {})


def named_number(name: str, trees: Mapping[str, Any]) -> int | None:
    """The number with that name in the modules."""
    for tree in trees.values():
        found = tree["values"].get(name)
        if found is not None and isinstance(found["value"], int):
            return int(found["value"])
    return None
