"""Message definitions given as text: `.msg` files, alone or with all types that they refer to.

A text may contain further types after lines of `=`, each introduced by `MSG: <type>`, as in recordings. This module
checks parsed definitions for errors that rosbags would only find later: missing types, and types that contain
themselves.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import get_types_from_idl, get_types_from_msg
from rosbags.typesys.base import TypesysError

_SEPARATOR = re.compile(r"^[ \t]*={3,}[ \t]*$", re.MULTILINE)
_MSG = "MSG: "
_HEADLINE = re.compile(r"MSG: [A-Za-z0-9/_]+[ \t]*")
_PARSER = (TypesysError, ValueError, TypeError, KeyError, IndexError, AssertionError, AttributeError, RecursionError)
"""Exceptions of rosbags for an invalid definition: its own error, and those that unusual texts cause in its parts."""

_UNSUPPORTED = {"wstring": "wide strings are not supported", "float128": "numbers of 16 bytes are not supported"}


_MISPLACED = "a line of `=` must stand before each further type and its `MSG: <type>`, and nowhere else"

_LONGEST = 2**31
"""No array has this many elements."""

_DEEPEST = 64
"""Maximum nesting of types: no real type comes near it, and the stack is bounded."""


@dataclass(frozen=True, slots=True)
class Definition:
    """The definition of a message type."""

    name: str
    """The type, e.g. my_package/msg/Track."""
    text: str
    """The contents of a .msg file."""


class DefinitionsError(ValueError):
    """Definitions that cannot be used; `problems` has the type and the reason of each."""

    def __init__(self, problems: Sequence[tuple[str, str]]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(f"{name}: {problem}" for name, problem in problems))


@lru_cache(maxsize=512)
def parsed(definition: Definition) -> Typesdict:
    """The type, and the others in the text. Raises DefinitionsError with the line."""
    text = _SEPARATOR.sub("=" * 80, definition.text.replace("\r\n", "\n")).rstrip() + "\n"
    try:
        return get_types_from_msg(text, definition.name)
    except _PARSER as error:
        raise DefinitionsError([(definition.name, _wrong_line(text) or _MISPLACED)]) from error


def from_idl(text: str) -> Typesdict:
    """The types defined by an IDL file, as in some recordings. Raises ValueError."""
    try:
        return get_types_from_idl(text)
    except _PARSER as error:
        raise ValueError(f"not valid IDL: {str(error)[:200]}") from None


def merged_types(definitions: Sequence[Definition]) -> Typesdict:
    """All types of the definitions. Raises DefinitionsError, with the problems of all of them."""
    types: Typesdict = {}
    given_in: dict[str, str] = {}
    problems: list[tuple[str, str]] = []
    for definition in definitions:
        try:
            inside = parsed(definition)
        except DefinitionsError as error:
            problems += error.problems
            continue
        for name, parts in inside.items():
            if name in types and types[name][1] != parts[1]:
                other = given_in[name]
                problems.append(
                    (definition.name, f"defines {name} differently than the definition of {other}: correct one")
                )
            else:
                types[name] = parts
                given_in.setdefault(name, definition.name)
    if problems:
        raise DefinitionsError(problems)
    return types


def check_definitions(definitions: Sequence[Definition], new: Typesdict, known: Mapping[str, Any]) -> None:
    """Check that fields are unique and of new or known types, and that no type contains itself.

    Raises DefinitionsError with the field.
    """
    problems = [
        (definition.name, f"{_place(definition, name, field)} {problem}")
        for definition in definitions
        for name in parsed(definition)
        for field, problem in _wrong_fields(new[name][1], {*new, *known})
    ]
    if not problems:
        seen: dict[str, int] = {}
        for definition in definitions:
            try:
                _depth(definition.name, new, seen)
            except _EndlessError as error:
                problems.append((definition.name, str(error)))
                break
    if problems:
        raise DefinitionsError(problems)


def _wrong_fields(fields: Iterable[tuple[str, FieldDesc]], known: Collection[str]) -> Iterator[tuple[str, str]]:
    seen: set[str] = set()
    for field, desc in fields:
        if field in seen:
            yield field, "is given twice: remove one"
        seen.add(field)
        kind, detail = desc
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and not 0 <= int(detail[1]) < _LONGEST:
            yield field, f"has {detail[1]} elements, which no message can have"
        below = message_type_of(desc)
        if below is not None and below not in known:
            yield field, f"has the type {_missing(below)}"


class _EndlessError(ValueError):
    """A type contains itself, or is nested too deeply."""


def _depth(name: str, types: Typesdict, seen: dict[str, int], above: tuple[str, ...] = ()) -> int:
    """The nesting depth of the type, without types that are known already. Raises _EndlessError."""
    if name in above:
        circle = " → ".join((*above[above.index(name) :], name))
        raise _EndlessError(f"it contains itself ({circle}), which no message can")
    if name not in types:
        return 0
    if name not in seen:
        below = (message_type_of(desc) for _, desc in types[name][1])
        seen[name] = 1 + max((_depth(each, types, seen, (*above, name)) for each in below if each), default=0)
    if len(above) + seen[name] > _DEEPEST:
        raise _EndlessError(f"{name} is nested more than {_DEEPEST} deep")
    return seen[name]


def message_type_of(desc: FieldDesc) -> str | None:
    """The message type of a field, or of its elements."""
    kind, detail = desc
    if kind is Nodetype.NAME:
        return str(detail)
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return message_type_of(detail[0])  # type: ignore[arg-type]
    return None


def _missing(name: str) -> str:
    reason = _UNSUPPORTED.get(name.rsplit("/", 1)[-1])
    return f"{name}: {reason}" if reason else f"{name}, which is unknown: also give its definition"


def _place(definition: Definition, type_name: str, field: str) -> str:
    """The field, and its line."""
    inside = re.split(r"\n=+\n", _SEPARATOR.sub("===", definition.text))
    wanted = type_name if type_name != definition.name else None
    offset = 1
    for part in inside:
        headline = part.split("\n", 1)[0]
        is_it = wanted is None if not headline.startswith(_MSG) else _same(headline[len(_MSG) :], type_name)
        if is_it:
            for number, line in enumerate(part.split("\n")):
                if re.match(rf"\s*\S+\s+{re.escape(field)}\b", line):
                    return f"line {offset + number}: {field}"
        offset += part.count("\n") + 2
    return field


def _same(written: str, type_name: str) -> bool:
    """Whether a type as written after MSG, perhaps without its folder, is that type."""
    return written.strip().replace("/msg/", "/") == type_name.replace("/msg/", "/")


def _wrong_line(text: str) -> str | None:
    """The first invalid line of a definition; each line is independent."""
    for number, line in enumerate(text.split("\n"), start=1):
        if line == "=" * 80 or _HEADLINE.fullmatch(line):
            continue
        try:
            get_types_from_msg(line, "a/msg/A")
        except _PARSER:
            return (
                f"line {number}: {line.strip()[:80]!r} is not a line of a .msg file: write a type and a name, such as "
                "float64 x"
            )
    return None
