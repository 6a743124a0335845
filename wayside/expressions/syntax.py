"""The syntax tree of a compiled expression, decoded from the CheckedExpr that CEL serialises, and the paths it reads.

The binding offers the tree only as protobuf. The few message types of the tree are decoded here, so that protobuf is
not a dependency. Field numbers are those of `cel/expr/syntax.proto`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

Step = str | int
Path = tuple[Step, ...]
"""A variable and the fields and literal indices below it: `msg.points[2].x` is ("msg", "points", 2, "x")."""


@dataclass(frozen=True, slots=True)
class Scalar:
    """A literal."""

    value: bool | int | float | str | bytes | None


@dataclass(frozen=True, slots=True)
class Name:
    """A variable, a loop variable or the name of a type."""

    name: str


@dataclass(frozen=True, slots=True)
class Select:
    """`operand.field`, or `has(operand.field)` if `test_only`."""

    operand: Node
    field: str
    test_only: bool


@dataclass(frozen=True, slots=True)
class Call:
    """A call of a function or operator (`_+_`, `_[_]`, …). `target` is the operand of a method call."""

    function: str
    target: Node | None
    arguments: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class Collection:
    """A list or map literal. For a map, keys and values alternate."""

    is_map: bool
    elements: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class Loop:
    """An expanded macro, such as `all`, `exists`, `filter` or `map`."""

    over: Node
    variables: tuple[str, ...]
    accumulator: str
    initial: Node
    body: tuple[Node, ...]
    result: Node


Node = Scalar | Name | Select | Call | Collection | Loop


def parse(serialized: bytes) -> Node:
    """The tree of an expression, from the result of the binding's `serialize()` (an Any with a CheckedExpr)."""
    checked = _fields(_only(_fields(serialized), 2))
    return _node(_only(checked, 4))


def paths(node: Node, variables: frozenset[str]) -> frozenset[Path]:
    """The longest literal paths below `variables` that the tree reads; loop variables of the same name do not count."""
    return frozenset(path for path, _ in _paths(node, variables))


def arguments(node: Node, variables: frozenset[str], functions: frozenset[str]) -> frozenset[Path]:
    """The longest literal paths that are arguments of the functions."""
    return frozenset(path for path, caller in _paths(node, variables) if caller in functions)


def nothing_but_arguments(node: Node, variables: frozenset[str], functions: frozenset[str]) -> frozenset[Path]:
    """The paths of `arguments` that overlap with no other path that the tree reads."""
    found = set(_paths(node, variables))
    passed = {path for path, caller in found if caller in functions}
    others = {path for path, caller in found if caller not in functions}
    return frozenset(
        path
        for path in passed
        if not any(path[: len(other)] == other or other[: len(path)] == path for other in others | passed - {path})
    )


def _paths(node: Node, free: frozenset[str], caller: str = "") -> Iterator[tuple[Path, str]]:
    """The paths, each with the function of which it is an argument; empty if it is not."""
    path = path_of(node, free)
    if path is not None:
        yield path, caller
        return
    match node:
        case Select(operand):
            yield from _paths(operand, free)
        case Call(function, target, arguments):
            if target is not None:
                yield from _paths(target, free)
            for part in arguments:
                yield from _paths(part, free, function)
        case Collection(_, elements):
            for part in elements:
                yield from _paths(part, free)
        case Loop(over, names, accumulator, initial, body, result):
            yield from _paths(over, free)
            yield from _paths(initial, free)
            for part in body:
                yield from _paths(part, free.difference(names, (accumulator,)))
            yield from _paths(result, free - {accumulator})


def calls(node: Node, function: str) -> Iterator[Call]:
    """All calls of the function in the tree."""
    match node:
        case Select(operand):
            yield from calls(operand, function)
        case Call(name, target, arguments):
            if name == function:
                yield node
            for part in (*([] if target is None else [target]), *arguments):
                yield from calls(part, function)
        case Collection(_, elements):
            for part in elements:
                yield from calls(part, function)
        case Loop(over, _, _, initial, body, result):
            for part in (over, initial, *body, result):
                yield from calls(part, function)


def path_of(node: Node, free: frozenset[str]) -> Path | None:
    """The literal path of the node, below the variables `free`; None if the node is something else."""
    match node:
        case Name(name):
            name = name.removeprefix(".")
            return (name,) if name in free else None
        case Select(operand, field):
            above = path_of(operand, free)
            return None if above is None else (*above, field)
        case Call("_[_]", None, (container, Scalar(str() | int() as index))) if not isinstance(index, bool):
            above = path_of(container, free)
            return None if above is None or (isinstance(index, int) and index < 0) else (*above, index)
    return None


_Fields = dict[int, list[bytes | int]]
_WIDTHS = {1: 8, 5: 4}


def _fields(data: bytes) -> _Fields:
    """The fields of a protobuf message by number. Varints are numbers, all other values are bytes."""
    result: _Fields = {}
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        wire = key & 7
        value: bytes | int
        if wire == 0:
            value, at = _varint(data, at)
        else:
            length, at = (_WIDTHS[wire], at) if wire in _WIDTHS else _varint(data, at)
            value, at = data[at : at + length], at + length
        result.setdefault(key >> 3, []).append(value)
    return result


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _only(fields: _Fields, number: int) -> bytes:
    values = fields.get(number, [b""])
    value = values[-1]
    return value if isinstance(value, bytes) else b""


def _text(fields: _Fields, number: int) -> str:
    return _only(fields, number).decode()


def _nodes(fields: _Fields, number: int) -> tuple[Node, ...]:
    return tuple(_node(part) for part in fields.get(number, ()) if isinstance(part, bytes))


def _node(data: bytes) -> Node:
    fields = _fields(data)
    for number, decode in _DECODERS.items():
        if number in fields:
            return decode(_fields(_only(fields, number)))
    raise ValueError("the output of CEL contains an expression of an unknown kind")


def _constant(fields: _Fields) -> Scalar:
    for number, values in fields.items():
        value = values[-1]
        match number, value:
            case 2, int():
                return Scalar(bool(value))
            case 3, int():
                return Scalar(value - 2**64 if value >= 2**63 else value)
            case 4, int():
                return Scalar(value)
            case 5, bytes():
                return Scalar(struct.unpack("<d", value)[0])
            case 6, bytes():
                return Scalar(value.decode())
            case 7, bytes():
                return Scalar(value)
    return Scalar(None)


def _call(fields: _Fields) -> Call:
    target = _node(_only(fields, 1)) if 1 in fields else None
    return Call(_text(fields, 2), target, _nodes(fields, 3))


def _map(fields: _Fields) -> Collection:
    entries = [_fields(entry) for entry in fields.get(2, ()) if isinstance(entry, bytes)]
    return Collection(
        is_map=True, elements=tuple(part for entry in entries for n in (3, 4) for part in _nodes(entry, n))
    )


def _loop(fields: _Fields) -> Loop:
    return Loop(
        over=_node(_only(fields, 2)),
        variables=tuple(name for name in (_text(fields, 1), _text(fields, 8)) if name),
        accumulator=_text(fields, 3),
        initial=_node(_only(fields, 4)),
        body=(*_nodes(fields, 5), *_nodes(fields, 6)),
        result=_node(_only(fields, 7)),
    )


_DECODERS: Mapping[int, Callable[[_Fields], Node]] = {
    3: _constant,
    4: lambda fields: Name(_text(fields, 1)),
    5: lambda fields: Select(_node(_only(fields, 1)), _text(fields, 2), test_only=3 in fields),
    6: _call,
    7: lambda fields: Collection(is_map=False, elements=_nodes(fields, 1)),
    8: _map,
    9: _loop,
}
