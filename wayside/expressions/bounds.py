"""Bounds on the cost of an expression: the size of its values, and of the regular expressions in it.

A short expression could fill the memory. CEL bounds the iterations of loops and the nesting of expressions, but not the
size of values: each nesting of `[text].map(a, a + a)[0]` in itself doubles the value. So a literal or variable has size
one, a composed value has the sum of the sizes of its parts, and the variable of a loop has the size of the list.

RE2's time is linear in the input and in the size of its program, and the program grows with counted repetitions:
`([ab]{50}){3}` has 150 classes. So the pattern of `matches` must be a literal, whose size is estimated here, and its
input is bounded. In the worst case, one match takes about 0.1 s.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from wayside.expressions.syntax import Call, Collection, Loop, Name, Node, Scalar, Select

LARGEST_PATTERN: Final = 1000
"""The maximum number of instructions of a pattern. A pattern for a Kubernetes name with its lengths has about 200."""

LONGEST_INPUT: Final = 4096
"""The maximum length of the input of `matches`, in bytes (UTF-8)."""

BOUNDED: Final = "bounded"
"""An internal function that checks the input of `matches`."""

_REPEAT: Final = re.compile(r"\{([0-9]+)(,([0-9]*))?\}")
_NAMED: Final = re.compile(r"\{\^?\w*\}|.", re.DOTALL)
_CODE: Final = re.compile(r"\{[0-9A-Fa-f]*\}|[0-9A-Fa-f]{2}")
_GROUP: Final = re.compile(r"\?(P?<\w+>|[a-zA-Z-]*:?)")
_ANY: Final = 10  # instructions of a class that contains most of Unicode, in UTF-8
_PROPERTY: Final = 300  # instructions of a class like \pL; the largest classes have about 600

MOST = 1000
"""The maximum size of a value, as the number of copies of its parts. Real expressions have a handful."""

_ONE_OF = ("_?_:_", "_[_]", "_[?_]")
_SCALARS = frozenset(
    {
        "_==_", "_!=_", "_<_", "_<=_", "_>_", "_>=_", "_&&_", "_||_", "!_", "@in", "@not_strictly_false", "-_", "_-_",
        "_*_", "_/_", "_%_", "size", "bool", "double", "int", "uint", "contains", "startsWith", "endsWith", "matches",
    }
)  # fmt: skip
"""Operators and functions whose result is always a number or a boolean."""


def growth(node: Node) -> int:
    """The maximum size of any value of the evaluation, as the number of copies of literals and variables."""
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
    """An open group: its size, and the size of its last part, to which a repetition applies."""

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
    """The approximate number of RE2 instructions of the pattern; any number for an invalid pattern."""
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
    """The size of the escape sequence after a backslash, and the offset of its end."""
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
    """The size of a class after its opening bracket, and the offset of its end."""
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
