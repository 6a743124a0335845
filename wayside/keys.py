"""Stream keys in Zenoh's key-format notation: `vehicles/${client:*}/pose`.

A key is a list of chunks between slashes. In a pattern, `*` stands for exactly one chunk, `**` for any number of chunks
(also none), and `$*` for any text inside a chunk; `${name:pattern}` captures the text that its pattern matches. As in
Zenoh, a capture covers whole chunks, wildcards match no chunk that begins with `@`, and the first of two `**` matches
as many chunks as possible.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_CHUNK = r"(?!@)[^/]+"
_CHUNKS = rf"{_CHUNK}(?:/{_CHUNK})*"


class KeyPatternError(ValueError):
    """A key that is not in key-format notation; the text names the column (from 1) and the remedy."""

    def __init__(self, text: str, offset: int, problem: str) -> None:
        """`offset` counts from 0 within `text`."""
        cut = 1 if not text or text.startswith("/") else 0  # the leading slash that was removed
        self.column = offset + 1 + (cut if text else 0)
        super().__init__(f"key {'/' * cut + text!r}, column {self.column}: {problem}")


@dataclass(frozen=True, slots=True)
class _Element:
    """One part between slashes: a chunk, `**`, or a capture over chunks."""

    regex: str
    many: bool = False
    """Whether it stands for any number of chunks, also none: without chunks, the slash beside it is absent as well."""


@dataclass(frozen=True, slots=True)
class KeyPattern:
    """A pattern for the keys of a stream, with its captures."""

    text: str
    expression: str
    """The key expression to subscribe to: the captures replaced by their patterns."""
    captures: tuple[str, ...]
    """The captured names, in order."""
    _regex: re.Pattern[str] = field(repr=False, compare=False)
    _captured: Mapping[str, re.Pattern[str]] = field(repr=False, compare=False)
    """The pattern that the text of each capture must match."""

    @classmethod
    def parse(cls, text: str) -> KeyPattern:
        """Reads the notation. Raises KeyPatternError."""
        elements: list[_Element] = []
        expression: list[str] = []
        captures: dict[str, re.Pattern[str]] = {}
        for offset, part in _parts(text):
            if "${" not in part:
                elements.append(_chunk(text, offset, part))
                expression.append(part)
                continue
            name, start, pattern = _capture(text, offset, part)
            if name in captures:
                raise KeyPatternError(text, offset, f"{name} is captured twice: names must be unique")
            inner = [_chunk(text, start + at, chunk) for at, chunk in _split(pattern)]
            if name == "client" and (len(inner) > 1 or inner[0].many):
                raise KeyPatternError(text, offset, "a client's name must be one chunk: write ${client:*}")
            many = all(element.many for element in inner)
            regex = _CHUNKS if many else _joined(inner)
            elements.append(_Element(f"(?P<{name}>{regex})", many))
            expression.append(pattern)
            captures[name] = re.compile(regex)
        return cls(text, "/".join(expression), tuple(captures), re.compile(_joined(elements)), captures)

    def can_capture(self, name: str, text: str) -> bool:
        """Whether the capture of that name can have this text."""
        return self._captured[name].fullmatch(text) is not None

    def match(self, key: str) -> dict[str, str] | None:
        """The captured texts by name if the key belongs to the stream, else None. A capture of no chunk is empty."""
        found = self._regex.fullmatch(key)
        return None if found is None else found.groupdict("")


def _parts(text: str) -> Iterator[tuple[int, str]]:
    """The parts between the slashes outside `${…}`, each with its offset."""
    if not text:
        raise KeyPatternError(text, 0, "it is empty: give a key such as vehicles/${client:*}/pose")
    start = position = 0
    while position < len(text):
        if text.startswith("${", position):
            end = text.find("}", position)
            if end < 0:
                raise KeyPatternError(text, position, "the capture is not closed: write ${name:*}")
            position = end
        elif text[position] == "/":
            yield start, _nonempty(text, start, text[start:position])
            start = position + 1
        position += 1
    yield start, _nonempty(text, start, text[start:])


def _nonempty(text: str, offset: int, part: str) -> str:
    if not part:
        if offset == len(text):
            problem = "the key ends with a slash: remove it"
        elif text[offset] == "}":
            problem = "the pattern ends with a slash: remove it"
        elif text[offset - 1] == ":":
            problem = "the pattern begins with a slash: remove it"
        else:
            problem = "the pattern has two slashes in a row: remove one"
        raise KeyPatternError(text, offset, problem)
    return part


def _split(pattern: str) -> Iterator[tuple[int, str]]:
    offset = 0
    for chunk in pattern.split("/"):
        yield offset, chunk
        offset += len(chunk) + 1


def _capture(text: str, offset: int, part: str) -> tuple[str, int, str]:
    """For a part that is a capture: its name, the offset of its pattern in the text, and its pattern."""
    if not part.startswith("${") or part.find("}") != len(part) - 1:
        raise KeyPatternError(text, offset, f"a capture must cover whole chunks: put slashes around ${{…}} in {part!r}")
    name, colon, pattern = part[2:-1].partition(":")
    if not _NAME.fullmatch(name):
        raise KeyPatternError(
            text, offset + 2, f"{name!r} is not a name: use letters, digits and _, as in ${{client:*}}"
        )
    if not colon or not pattern:
        raise KeyPatternError(text, offset, f"the capture has no pattern: write ${{{name}:*}}")
    return name, offset + len(name) + 3, pattern


def _chunk(text: str, offset: int, chunk: str) -> _Element:
    _nonempty(text, offset, chunk)
    if chunk == "**":
        return _Element(_CHUNKS, many=True)
    if chunk == "*":
        return _Element(_CHUNK)
    pieces = chunk.split("$*")
    for piece in pieces:
        if (bad := re.search(r"[*$?#{}]", piece)) is not None:
            remedy = (
                "within a chunk, write $* as the wildcard" if bad[0] == "*" else "remove it, since Zenoh reserves it"
            )
            raise KeyPatternError(text, offset, f"{bad[0]!r} is not allowed in the chunk {chunk!r}: {remedy}")
    guard = "(?!@)" if not pieces[0] else ""
    body = "[^/]*".join(map(re.escape, pieces))
    return _Element(f"{guard}(?=[^/]){body}")


def _joined(elements: list[_Element]) -> str:
    """The elements with slashes between them; an element that may be empty includes the slash beside it."""
    fixed = next((index for index, element in enumerate(elements) if not element.many), 0)
    return "".join(
        f"(?:{element.regex}/)?"
        if index < fixed
        else element.regex
        if index == fixed
        else f"(?:/{element.regex})?"
        if element.many
        else f"/{element.regex}"
        for index, element in enumerate(elements)
    )
