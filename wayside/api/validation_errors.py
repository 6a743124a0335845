"""Turns pydantic's validation errors into messages for the author of an object."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Collection, Iterator
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from wayside.api.base import LABEL, SUBDOMAIN

FieldPath = tuple[str | int, ...]

_PATTERNS = {
    f"^{LABEL}$": "lower-case letters, digits and -, with a letter or digit at both ends",
    f"^{SUBDOMAIN}$": "lower-case letters, digits, - and ., with a letter or digit at both ends and beside each .",
    r"^([A-Za-z0-9._:-]{1,63}|.*[$][{].*)$": "a name of up to 63 letters, digits, . _ : -, or a template such as "
    "its-${msg.id}",
    r"^[A-Za-z0-9._:-]+$": "letters, digits and . _ : -",
    r"^[A-Za-z_][A-Za-z0-9_]*$": "letters, digits and _, not beginning with a digit",
    r"^[A-Za-z][A-Za-z0-9_]*/msg/[A-Za-z][A-Za-z0-9_]*$": "package/msg/Type, e.g. geometry_msgs/msg/PoseStamped",
    r"^https?://[^\s/?#@\\]+([/?][^\s#]*)?$": "a URL such as https://host:port/path, without # and without credentials "
    "(for these, use credentialsSecretName)",
    r"^[^/*$#?]+(/[^/*$#?]+)*$": "a Zenoh key without wildcards, e.g. city/alerts",
    r"^WAYSIDE_[A-Z0-9_]+$": "a name in capitals that begins with WAYSIDE_, since rules cannot use other variables",
    r"^([-a-z0-9.]{1,253}/)?[A-Za-z0-9]([-_.A-Za-z0-9]*[A-Za-z0-9])?$": "a label's key, e.g. site or example.com/site",
    r"^([A-Za-z0-9]([-_.A-Za-z0-9]*[A-Za-z0-9])?)?$": "a label's value: up to 63 letters, digits, - _ . with a letter "
    "or digit at both ends",
    r"^[a-z]+/.+$": "protocol/address:port, e.g. tcp/zenoh:7447",
}
"""The models' patterns in words."""


def field_text(path: FieldPath) -> str:
    """A field's path in the usual notation, e.g. spec.signals[0].value."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def messages(
    error: ValidationError, raw: Any, fields: Callable[[FieldPath], Collection[str]] = lambda _: ()
) -> Iterator[tuple[FieldPath, str]]:
    """The messages for pydantic's errors, each once, with the paths as the author wrote them.

    Args:
        error: the error of the validation.
        raw: the object that was validated.
        fields: returns the names of the fields of the object at a path.
    """
    seen = set()
    for item in error.errors(include_url=False):
        path = _written(item["loc"], raw)
        if item["type"] == "extra_forbidden":
            found = path, _unknown(str(path[-1]), fields(path[:-1])) if path else _message(item)
        else:
            found = path, _message(item)
        if found not in seen:
            seen.add(found)
            yield found


def _unknown(name: str, fields: Collection[str]) -> str:
    """The message for a field that does not exist. It names the most similar field, or all where there is none."""
    stem = name.lower().rstrip("s")
    similar = [*(each for each in fields if each.lower().startswith(stem)), *difflib.get_close_matches(name, fields, 1)]
    if similar:
        return f"unknown field: did you mean {similar[0]}?"
    there = f"; the fields here are {', '.join(sorted(fields))}" if fields else ""
    return f"unknown field: check its spelling and indentation{there}"


def _message(item: ErrorDetails) -> str:
    given = item["input"]
    match item["type"]:
        case "missing":
            return "is missing: add it"
        case "value_error":
            return str(item["ctx"]["error"])
        case _ if given is None:
            return "is empty: give it a value, or remove it"
        case "string_type" if isinstance(given, bool | int | float):
            written = str(given).lower() if isinstance(given, bool) else str(given)
            return f"must be a string; got {written}: put it in quotes, as in '{written}'"
        case "string_type":
            return f"must be a string; got {_short(given)}: put the whole value in quotes"
        case "bool_type" | "bool_parsing":
            return f"must be true or false; got {_short(given)}"
        case "model_type" | "model_attributes_type" | "dict_type":
            return f"must be an object; got {_short(given)}"
        case "string_pattern_mismatch":
            pattern = item["ctx"]["pattern"]
            return f"must be {_PATTERNS.get(pattern, f'text like {pattern}')}; got {_short(given)}"
        case _:
            wanted = re.sub(r"^(Input|String|List|Dictionary|Value) should ", "must ", item["msg"])
            return f"{wanted}; got {_short(given)}"


def _written(location: tuple[int | str, ...], raw: Any) -> FieldPath:
    """Drop the parts of a location that pydantic adds and that are not in the file (function and union tags)."""
    path: list[str | int] = []
    here = raw
    for index, part in enumerate(location):
        last = index == len(location) - 1
        if isinstance(here, dict) and (part in here or last):
            here = here.get(part)
        elif isinstance(here, list) and isinstance(part, int) and part < len(here):
            here = here[part]
        elif not last:
            continue
        else:
            break
        path.append(part)
    return tuple(path)


def _short(value: Any, limit: int = 80) -> str:
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 1] + "…"
