"""Constants that a rule's expressions share: numbers, texts, booleans, and lists and maps of them, such as polygons."""

from __future__ import annotations

import json
import math
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from wayside.api.base import Identifier, JsonValue

MAXIMUM_BYTES = 64 * 1024
"""All constants together, as JSON."""

_MAXIMUM_DEPTH = 8


def checked(constants: dict[str, Any]) -> dict[str, Any]:
    """The constants, if expressions can take them. Raises ValueError, which names the value and the remedy."""
    for name, value in constants.items():
        _check(name, value, _MAXIMUM_DEPTH)
    size = len(json.dumps(constants))
    if size > MAXIMUM_BYTES:
        raise ValueError(f"the total size of {size} bytes exceeds the limit of {MAXIMUM_BYTES}: shorten the values")
    return constants


def _check(name: str, value: object, depth: int) -> None:
    if value is None:
        raise ValueError(f"{name} is null: give it a value, or remove it")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} is {value}: give a finite number")
    if not isinstance(value, bool | int | float | str | list | dict):
        raise ValueError(f"{name} is a {type(value).__name__}: write it as a string, in quotes")
    if isinstance(value, list | dict):
        if depth == 0:
            raise ValueError(f"{name} is nested more than {_MAXIMUM_DEPTH} levels deep: flatten it")
        for part, child in enumerate(value) if isinstance(value, list) else value.items():
            _check(f"{name}[{part}]" if isinstance(part, int) else f"{name}.{part}", child, depth - 1)


Constants = Annotated[dict[Identifier, JsonValue], Field(max_length=64), AfterValidator(checked)]
"""By the names that expressions use."""
