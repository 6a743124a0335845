"""Message definitions given as text: `.msg` files, alone or with all that they refer to.

A text may hold further types behind lines of `=`, each begun by `MSG: <type>`, as recordings hold them. What rosbags
parses is checked here for what would only fail later: types that are not there, and types that hold themselves.
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
"""What rosbags raises where a text is no definition: its own error, and what a strange text makes its parts raise."""

_UNSUPPORTED = {"wstring": "wide strings are not supported", "float128": "numbers of 16 bytes are not supported"}


_MISPLACED = "a line of `=` must stand before each further type and its `MSG: <type>`, and nowhere else"

_LONGEST = 2**31
"""So many elements has no array."""

_DEEPEST = 64
"""How deep types may be nested: no real one comes near, and the stack bounds it."""


@dataclass(frozen=True, slots=True)
class Definition:
    """What a message type is made of."""

    name: str
    """The type, e.g. my_package/msg/Track."""
    text: str
    """As a .msg file holds it."""


class DefinitionsError(ValueError):
    """Definitions that cannot be used; `problems` has the type that each is about, and what is wrong."""

    def __init__(self, problems: Sequence[tuple[str, str]]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(f"{name}: {problem}" for name, problem in problems))


@lru_cache(maxsize=512)
def parsed(definition: Definition) -> Typesdict:
    """The type, and those that the text holds beside it. Raises DefinitionsError, which gives the line."""
    text = _SEPARATOR.sub("=" * 80, definition.text.replace("\r\n", "\n")).rstrip() + "\n"
    try:
        return get_types_from_msg(text, definition.name)
    except _PARSER as error:
        raise DefinitionsError([(definition.name, _wrong_line(text) or _MISPLACED)]) from error


def from_idl(text: str) -> Typesdict:
    """The types that an IDL file, as some recordings hold them, defines. Raises ValueError."""
    try:
        return get_types_from_idl(text)
    except _PARSER as error:
        raise ValueError(f"not valid IDL: {str(error)[:200]}") from None


def merged_types(definitions: Sequence[Definition]) -> Typesdict:
    """All types that the definitions hold. Raises DefinitionsError, with the problems of all of them."""
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


def check(definitions: Sequence[Definition], new: Typesdict, known: Mapping[str, Any]) -> None:
    """That fields are there once, of types that are new or known, and that no type holds itself.

    Raises DefinitionsError, which gives the field.
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
            yield field, f"is of {_missing(below)}"


class _EndlessError(ValueError):
    """A type that holds itself, or is nested as if it did."""


def _depth(name: str, types: Typesdict, seen: dict[str, int], above: tuple[str, ...] = ()) -> int:
    """How deep the type is nested, not counting what is known beforehand. Raises _EndlessError."""
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
    """The message type that a field is of, or its elements are."""
    kind, detail = desc
    if kind is Nodetype.NAME:
        return str(detail)
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return message_type_of(detail[0])  # type: ignore[arg-type]
    return None


def _missing(name: str) -> str:
    reason = _UNSUPPORTED.get(name.rsplit("/", 1)[-1])
    return f"{name}: {reason}" if reason else f"{name}, which is unknown: give its definition as well"


def _place(definition: Definition, type_name: str, field: str) -> str:
    """The field, and the line where it stands."""
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
    """Whether a type as written behind MSG, perhaps without its folder, is that type."""
    return written.strip().replace("/msg/", "/") == type_name.replace("/msg/", "/")


def _wrong_line(text: str) -> str | None:
    """Which line is none of a definition; they stand each for itself."""
    for number, line in enumerate(text.split("\n"), start=1):
        if line == "=" * 80 or _HEADLINE.fullmatch(line):
            continue
        try:
            get_types_from_msg(line, "a/msg/A")
        except _PARSER:
            return (
                f"line {number}: {line.strip()[:80]!r} is not a line of a .msg file: write a type and a "
                "name, as float64 x"
            )
    return None
