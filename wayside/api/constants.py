"""Constants that a rule's expressions share: numbers, texts, booleans, and lists and maps of them, such as polygons."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, Field

from wayside.api.base import Identifier
from wayside.api.freedata import Value, bounded


def _checked(constants: dict[str, Any]) -> dict[str, Any]:
    """The constants, if expressions can take them. Raises ValueError, which names the value and the remedy."""
    bounded(constants)
    for name, value in constants.items():
        _check(name, value)
    return constants


def _check(name: str, value: object) -> None:
    if value is None:
        raise ValueError(f"{name} is null: give it a value, or remove it")
    if not isinstance(value, bool | int | float | str | list | dict):
        raise ValueError(f"{name} is a {type(value).__name__}: write it as a string, in quotes")
    if isinstance(value, list | dict):
        for part, child in enumerate(value) if isinstance(value, list) else value.items():
            _check(f"{name}[{part}]" if isinstance(part, int) else f"{name}.{part}", child)


Constants = Annotated[dict[Identifier, Value], Field(max_length=64), AfterValidator(_checked)]
"""By the names that expressions use."""
