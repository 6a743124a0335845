"""Free data: maps of any JSON values, with bounds; and constants, which expressions can read.

The schema bounds each value. `check`, the webhook and the manager check the total size.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field
from pydantic.config import JsonDict

from wayside.api.base import Identifier, JsonValue

MAXIMUM_BYTES = 64 * 1024
"""The maximum size of one map as JSON."""

MAXIMUM_DEPTH = 5
"""The maximum levels of lists and maps in one value. The coordinates of a GeoJSON MultiPolygon have four."""

_WIDTH: JsonDict = {"maxLength": MAXIMUM_BYTES, "maxItems": MAXIMUM_BYTES // 2, "maxProperties": MAXIMUM_BYTES // 5}
"""Limits that no value within `MAXIMUM_BYTES` exceeds: an item takes at least two bytes, a named value five."""

Value = Annotated[JsonValue, Field(json_schema_extra=_WIDTH)]
"""A JSON value whose first level the API server bounds."""


def _nested(levels: int) -> JsonDict:
    """The schema of a value with at most these levels of lists and maps that are not empty."""
    if levels == 0:
        return {**_FREE, "maxLength": MAXIMUM_BYTES, "maxItems": 0, "maxProperties": 0}
    return {**_FREE, **_WIDTH, "items": _nested(levels - 1), "additionalProperties": _nested(levels - 1)}


_FREE: JsonDict = {"x-kubernetes-preserve-unknown-fields": True}

NestedValue = Annotated[JsonValue, Field(json_schema_extra={"x-wayside-schema": _nested(MAXIMUM_DEPTH)})]
"""A JSON value of which the API server bounds every level, for kinds that no webhook reviews."""


def size(data: Mapping[str, Any]) -> int:
    """The size of the map as JSON, in bytes."""
    return len(json.dumps(dict(data), ensure_ascii=False, separators=(",", ":")).encode())


def bounded(data: dict[str, Any]) -> dict[str, Any]:
    """The map, if it is within the bounds. Raises ValueError, which names the value and the remedy."""
    for name, value in data.items():
        _check_depth(name, value, MAXIMUM_DEPTH)
    return of_bounded_size(data)


def of_bounded_size(data: dict[str, Any]) -> dict[str, Any]:
    """The map, if it is not too large. Raises ValueError as `bounded` does."""
    total = size(data)
    if total > MAXIMUM_BYTES:
        name = max(data, key=lambda each: size({each: data[each]}))
        raise ValueError(
            f"the total size of {total} bytes as JSON exceeds the limit of {MAXIMUM_BYTES}: "
            f"shorten the largest value, {name}, or refer to a file"
        )
    return data


def fitting(data: Mapping[str, Any]) -> dict[str, Any]:
    """The map without values that are nested too deeply, and without the largest values beyond the maximum size."""
    kept = {name: value for name, value in data.items() if _depth(value) <= MAXIMUM_DEPTH}
    total = size(kept)
    if total > MAXIMUM_BYTES:
        sizes = {name: size({name: value}) for name, value in kept.items()}
        for name in sorted(sizes, key=lambda each: (-sizes[each], each)):
            del kept[name]
            total -= sizes[name] - 1  # its braces stay
            if total <= MAXIMUM_BYTES:
                break
    return kept


def _depth(value: object) -> int:
    if isinstance(value, list | dict) and value:
        return 1 + max(map(_depth, value if isinstance(value, list) else value.values()))
    return 0


def _check_depth(name: str, value: object, levels: int) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number; got {value}")
    if isinstance(value, list | dict):
        if levels == 0 and value:
            raise ValueError(f"{name} is nested more than {MAXIMUM_DEPTH} levels deep: flatten it")
        for part, child in enumerate(value) if isinstance(value, list) else value.items():
            _check_depth(f"{name}[{part}]" if isinstance(part, int) else f"{name}.{part}", child, levels - 1)


FreeData = Annotated[dict[str, Value], Field(max_length=64), AfterValidator(bounded)]
"""Free data with any names."""

NamedData = Annotated[dict[Identifier, Value], Field(max_length=64), AfterValidator(bounded)]
"""Free data whose names expressions can use."""


def _checked_constants(constants: dict[str, Any]) -> dict[str, Any]:
    """The constants, if expressions can read them. Raises ValueError, which names the value and the remedy."""
    bounded(constants)
    for name, value in constants.items():
        _check_constant(name, value)
    return constants


def _check_constant(name: str, value: object) -> None:
    if value is None:
        raise ValueError(f"{name} is null: give it a value, or remove it")
    if not isinstance(value, bool | int | float | str | list | dict):
        raise ValueError(f"{name} is a {type(value).__name__}: write it as a string, in quotes")
    if isinstance(value, list | dict):
        for part, child in enumerate(value) if isinstance(value, list) else value.items():
            _check_constant(f"{name}[{part}]" if isinstance(part, int) else f"{name}.{part}", child)


Constants = Annotated[dict[Identifier, Value], Field(max_length=64), AfterValidator(_checked_constants)]
"""Constants that a rule's expressions share, by name: numbers, strings, booleans, and lists and maps of them."""
