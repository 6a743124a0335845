"""Turns CEL's errors of a failed evaluation into messages for the author of the rule."""

from __future__ import annotations

import re
from typing import Final

from wayside.expressions.functions import FUNCTIONS
from wayside.expressions.numbers import DIGITS

_NO_MEMBERS: Final = "it reads a field of a value without fields"
NO_MEMBERS: Final = frozenset({_NO_MEMBERS})
"""The message of `clean` for reading a member of a number, a string or a list."""

_ABSENT = ("no value for ", "no key ", "no index ")
_OVERLOAD: Final = re.compile(r"^\w+: No matching overloads found : (.*)$")
_CALL: Final = re.compile(r"^([^(]+)\((.*)\)$")
_OF_A_FIELD: Final = re.compile(r"\b(at|seen)_(\w+)")
_WRITTEN: Final = {"at": "at", "seen": "seenFrom"}
_COMPARISONS: Final = frozenset({"<", "<=", ">", ">="})
_NAMES: Final = {"[]": "[…]", "?:": "? :"}
_OF_BYTES: Final = "byteCount, checksum, allZero, numberAt or utf8"
_CLEANING: Final = (
    (re.compile(r'^\w+: No value with name "(.*)" found in Activation$'), r"no value for `\1`"),
    (re.compile(r"^\w+: Key not found in map : (.*)$"), r"no key \1 in the map"),
    (re.compile(r"^\w+: Index error: index=(.*) size=(.*)$"), r"no index \1 in the list"),
    (re.compile(r"^(?:\w+: )?Applying SELECT to non-message type.*$"), _NO_MEMBERS),
    (re.compile(r"^[A-Z_]+: (.*?)(?: \[[A-Z_]+\])?$", re.DOTALL), r"\1"),
)
_TYPES: Final = {
    "double": "number",
    "string": "text",
    "bool": "boolean",
    "int64": "integer beyond 2^53",
    "uint64": "list, map or bytes",  # a handle
    "null_type": "null",
}


def clean(message: str) -> str:
    """The message without CEL's codes, and in the words of the documentation."""
    message = _OF_A_FIELD.sub(lambda found: f"{_WRITTEN[found[1]]}(…).{found[2]}", message)
    overload = _OVERLOAD.search(message)
    if overload is not None:
        return _no_overload(overload[1])
    for pattern, replacement in _CLEANING:
        if pattern.search(message):
            return pattern.sub(replacement, message)
    return message


def reports_absent(message: str) -> bool:
    """Whether a clean message reports an absent value."""
    return message.startswith(_ABSENT)


def _no_overload(operation: str) -> str:
    """Of a function of ours, what it takes and was given; of CEL's operations, those on bytes have a remedy."""
    if operation.startswith(f"{DIGITS}("):
        operation = operation.replace(DIGITS, "string", 1)
    call = _CALL.search(operation)
    if call is not None and (function := FUNCTIONS.get(call[1])) is not None:
        given = ", ".join(_TYPES.get(kind, kind) for kind in call[2].split(", "))
        return f"{function.usage()} takes {function.types()}; got {given}"
    if call is None:
        return f"the operation does not take these types: {operation}"
    name = call[1].replace("_", "").lstrip("@") if not call[1].isalpha() else call[1]
    kinds = [_a(kind) for kind in call[2].split(", ")]
    if name in _COMPARISONS:
        text = f"`{name}` compares {kinds[0]} with {kinds[1]}"
    else:
        text = f"`{_NAMES.get(name, name)}` does not take {' and '.join(kinds)}"
    return f"{text}: for bytes, use {_OF_BYTES}" if "uint64" in operation else text


def _a(kind: str) -> str:
    """The type as it stands in a sentence."""
    name = _TYPES.get(kind, kind)
    return name if name == "null" else f"{'an' if name[0] in 'aeiou' else 'a'} {name}"
