"""The fields of messages. Misspelt fields are found before any sample arrives."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from wayside.expressions import Path
from wayside.names import did_you_mean

Fields = Mapping[str, "Fields | None"]
"""The fields of a message by name. The value None means that a field has no fields, or that they are unknown."""


BYTES: Fields = {}
"""The fields of a message that consists of bytes: none."""


class ItemFields(dict[str, "Fields | None"]):
    """The fields of each item of a list."""


def unknown_fields(paths: Iterable[Path], variable: str, fields: Fields) -> Iterable[str]:
    """A message for each path that starts at the variable and names a field that does not exist."""
    for path in sorted(paths, key=str):
        if path[0] != variable:
            continue
        here: Fields | None = fields
        for depth, step in enumerate(path[1:], start=1):
            if isinstance(here, ItemFields):
                if isinstance(step, str):
                    parent = ".".join(map(str, path[:depth]))
                    yield f"{parent} is a list and has no field {step}; read an item, e.g. {parent}[0].{step}"
                    break
                here = dict(here)
                continue
            if here is None or not isinstance(step, str):
                break
            if step not in here:
                yield _message(".".join(map(str, path[:depth])), step, here)
                break
            here = here[step]


def fields_at(path: Path, fields: Fields | None) -> Fields | None:
    """The fields of the value at a path below a message; None if they are unknown."""
    for step in path:
        if fields is None:
            return None
        if isinstance(fields, ItemFields):
            fields = dict(fields) if isinstance(step, int) else None
        else:
            fields = fields.get(str(step))
    return fields


def _message(parent: str, step: str, here: Fields) -> str:
    if here is BYTES:
        return (
            f"{parent} has no field {step}: it is bytes; read it with numberAt or utf8, or give the stream's encoding"
        )
    hint = did_you_mean(step, here) or f"it has {', '.join(sorted(here)) or 'no fields'}"
    return f"{parent} has no field {step}; {hint}"
