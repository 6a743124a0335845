"""Bounds of what an expression may cost: the size of its result, and of the regular expressions in it.

A short expression could fill the memory. CEL bounds how often a loop runs, and how deep an expression is nested, but
not how large a value becomes: `[text].map(a, a + a)[0]`, within itself and again, doubles it each time. So each literal
and each variable counts as one, what is put together counts as its parts do, and a loop's variable as what the loop
runs over.

RE2's time is linear in the text, but also in its program, and the program grows with counted repetitions:
`([ab]{50}){3}` is 150 classes. So the pattern of `matches` must be a literal, whose size is estimated here from its
text, and its input is bounded. One match then takes some 0.1 s at the very worst.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from wayside.expressions.syntax import Call, Collection, Loop, Name, Node, Scalar, Select

LARGEST_PATTERN: Final = 1000
"""The most instructions of a pattern: a name of Kubernetes with its lengths takes some 200."""

LONGEST_INPUT: Final = 4096
"""Bytes (UTF-8) of a text that `matches` takes."""

BOUNDED: Final = "bounded"
"""Not for authors: the function that `matches` is given its text by."""

_REPEAT: Final = re.compile(r"\{([0-9]+)(,([0-9]*))?\}")
_NAMED: Final = re.compile(r"\{\^?\w*\}|.", re.DOTALL)
_CODE: Final = re.compile(r"\{[0-9A-Fa-f]*\}|[0-9A-Fa-f]{2}")
_GROUP: Final = re.compile(r"\?(P?<\w+>|[a-zA-Z-]*:?)")
_ANY: Final = 10  # instructions of a class with most of Unicode in it, in UTF-8
_PROPERTY: Final = 300  # of a class like \pL, the largest of which have some 600

MOST = 1000
"""The maximum number of copies of its parts in a value. Expressions in practice have a handful."""

_ONE_OF = ("_?_:_", "_[_]", "_[?_]")
_SCALARS = frozenset(
    {
        "_==_", "_!=_", "_<_", "_<=_", "_>_", "_>=_", "_&&_", "_||_", "!_", "@in", "@not_strictly_false", "-_", "_-_",
        "_*_", "_/_", "_%_", "size", "bool", "double", "int", "uint", "contains", "startsWith", "endsWith", "matches",
    }
)  # fmt: skip
"""Operators and functions whose result is always a number or a truth."""


def growth(node: Node) -> int:
    """The most copies of literals and variables that any value on the way may hold."""
    largest = 0

    def copies(node: Node, known: Mapping[str, int]) -> int:
        nonlocal largest
        found = max(1, weigh(node, known))
        largest = max(largest, found)
        return found

    def weigh(node: Node, known: Mapping[str, int]) -> int:
        match node:
            case Scalar():
                return 1
            case Name(name):
                return known.get(name, 1)
            case Select(operand, _, test_only):
                inner = copies(operand, known)
                return 1 if test_only else inner
            case Call(function, target, arguments):
                parts = [copies(each, known) for each in (*([] if target is None else [target]), *arguments)]
                if function in _SCALARS:
                    return 1
                return max(parts, default=1) if function in _ONE_OF else sum(parts)
            case Collection(_, elements):
                return sum(copies(each, known) for each in elements)
            case Loop(over, names, accumulator, initial, body, result):
                within = {**known, **dict.fromkeys(names, copies(over, known)), accumulator: copies(initial, known)}
                step = max((copies(each, within) for each in body), default=1)
                return copies(result, {**known, accumulator: step})

    copies(node, {})
    return largest


@dataclass
class _Group:
    """A group that is still open: the size of what it holds, and of its last part, which a repetition repeats."""

    size: int = 2
    last: int = 0
    inner: list[int] = field(default_factory=list)

    def add(self, size: int) -> None:
        self.size += size
        self.last = size

    def repeat(self, times: int) -> None:
        grown = self.last * times + 1
        self.size += grown - self.last
        self.last = grown


def pattern_size(pattern: str) -> int:
    """About how many instructions RE2 makes of the pattern; of one that is none, any number."""
    groups, at = [_Group()], 0
    while at < len(pattern):
        char = pattern[at]
        at += 1
        group = groups[-1]
        if char == "(":
            found = _GROUP.match(pattern, at)
            at = found.end() if found is not None else at
            if found is None or pattern[at - 1 : at] != ")":
                groups.append(_Group())
        elif char == ")" and len(groups) > 1:
            groups.pop()
            groups[-1].add(group.size)
        elif char == "[":
            size, at = _class(pattern, at)
            group.add(size)
        elif char == "\\":
            size, at = _escape(pattern, at)
            group.add(size)
        elif char in "*+?":
            group.repeat(1)
        elif char == "{" and (counted := _REPEAT.match(pattern, at - 1)) is not None:
            at = counted.end()
            group.repeat(max(1, *(int(each) for each in (counted[1], counted[3]) if each)))
        else:
            group.add(_ANY if char == "." else len(char.encode(errors="replace")))
    while len(groups) > 1:
        size = groups.pop().size
        groups[-1].add(size)
    return groups[0].size


def _escape(pattern: str, at: int) -> tuple[int, int]:
    """The size of what stands behind a backslash, and where it ends."""
    char = pattern[at : at + 1]
    if char in ("p", "P"):
        found = _NAMED.match(pattern, at + 1)
        return _PROPERTY, found.end() if found is not None else at + 1
    if char == "x":
        found = _CODE.match(pattern, at + 1)
        return 4, found.end() if found is not None else at + 1
    if char == "Q":
        end = pattern.find("\\E", at)
        end = len(pattern) if end < 0 else end
        return max(1, len(pattern[at + 1 : end].encode(errors="replace"))), min(len(pattern), end + 2)
    return (_ANY if char in ("D", "S", "W", "C") else 4), at + 1


def _class(pattern: str, at: int) -> tuple[int, int]:
    """The size of a class whose bracket is open, and where it ends."""
    size = 1
    if pattern.startswith("^", at):
        size, at = _ANY, at + 1
    first = True
    while at < len(pattern) and (first or pattern[at] != "]"):
        first = False
        if pattern.startswith("[:", at) and (end := pattern.find(":]", at)) > 0:
            size, at = size + 4, end + 2
        elif pattern[at] == "\\":
            more, at = _escape(pattern, at + 1)
            size += more
        else:
            size += 0 if pattern[at] == "-" else 1 if pattern[at] < "\x80" else 4
            at += 1
    return size, at + 1
