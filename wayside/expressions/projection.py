"""Projects a message to the values that an expression reads, in the types of CEL.

CEL converts a message as a whole, at a cost that grows with it, and one member that it does not know spoils the rest.
So the paths that an expression reads form a tree, and only what lies on it is copied out of the values, and converted:

* integers become doubles, up to 2^53; beyond, they stay integers, which support only equality, `in` and order;
* numpy arrays and tuples become lists, numpy scalars plain ones, dataclasses (decoded ROS messages) maps;
* NUL, at which CEL would cut a string, becomes `␀` (U+2400);
* bytes, which CEL would cut as well, become handles (see `handles`), and so do the lists and maps that are nothing but
  arguments of functions.

With `known=True`, null and NaN are absent too: left out of maps, so that a read of them is an error in CEL, which `&&`,
`||` and `?:` treat as unknown. In lists they become null, so that no index shifts: order and arithmetic are unknown.
"""

from __future__ import annotations

import dataclasses
import datetime
import enum
from collections.abc import Iterable, Mapping
from typing import Final, cast

from wayside.expressions.errors import EvaluationError
from wayside.expressions.handles import hand
from wayside.expressions.numbers import MAX_EXACT
from wayside.expressions.syntax import Path, Step
from wayside.names import did_you_mean

_ABSENT: Final = object()


class Leaf(enum.Enum):
    """The parts of a value that are read, unless all of it is."""

    HANDED = "handed"
    """Its handle, where it is a list, a map or bytes."""
    ORDERED = "ordered"
    """All of it, but bytes are absent: a handle would be greater than every number."""


Tree = Mapping[Step, "Tree | Leaf | None"]
"""The parts that are read below a value; None: all of it."""

_FIELD_NAMES: Final[dict[type, frozenset[str]]] = {}


def tree(paths: Iterable[Path], leaves: Mapping[Path, Leaf]) -> Tree:
    """The tree of the given paths; a path replaces all longer ones. `leaves` defines how some are read."""
    root: dict[Step, Tree | Leaf | None] = {}
    for path in sorted(paths, key=len):  # the shorter first: it swallows the longer
        node = root
        for step in path[:-1]:
            below = node.setdefault(step, {})
            if below is None or isinstance(below, Leaf):
                break
            node = cast("dict[Step, Tree | Leaf | None]", below)
        else:
            node.setdefault(path[-1], leaves.get(path))
    return root


def project(read: Tree, values: Mapping[str, object], *, known: bool) -> dict[str, object]:
    """The part of `values` that is read. Raises EvaluationError for a value of a type that no expression takes."""
    result: dict[str, object] = {}
    for name, below in read.items():
        if isinstance(name, str) and name in values:
            value = _project(below, values[name], known)
            if value is not _ABSENT:
                result[name] = value
    return result


def normalise(value: object) -> object:
    """A decoded value as CEL takes it, the whole of it, null and NaN kept; bytes are null in lists, absent in maps."""
    result = _convert(value, known=False)
    return None if result is _ABSENT else result


def missing_path(paths: Iterable[Path], values: Mapping[str, object]) -> str | None:
    """The message for a path that does not exist in `values`, with the closest match; None if all exist."""
    for path in sorted(paths, key=str):
        at: object = values
        for depth, step in enumerate(path):
            if not isinstance(at, Mapping):
                break
            if step not in at:
                written = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path[: depth + 1])
                similar = did_you_mean(str(step), map(str, at), "`")
                return f"there is no `{written[1:]}`{similar and '; '}{similar}"
            at = at[step]
    return None


def no_member(paths: Iterable[Path], values: Mapping[str, object]) -> str | None:
    """The message for a path through a value without members, with its type; None if there is none."""
    for path in sorted(paths, key=str):
        at: object = values
        for depth, step in enumerate(path):
            if _is_array(at):
                at = at.tolist()  # type: ignore[attr-defined]
            if isinstance(at, Mapping):
                if step not in at:
                    break
                at = at[step]
            elif _is_record(at):
                if step not in _field_names(at):
                    break
                at = getattr(at, str(step))
            elif isinstance(at, list | tuple) and isinstance(step, int):
                if step >= len(at):
                    break
                at = at[step]
            elif depth and isinstance(step, str):
                written = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path[:depth])[1:]
                return f"`{written}` is {_shown(at)}, which has no field `{step}`: {_remedy(at)}"
            else:
                break
    return None


def _shown(value: object) -> str:
    if value is None:
        return "null"
    if isinstance(value, list | tuple):
        return f"the list of {len(value)}"
    if isinstance(value, bytes | bytearray | memoryview):
        return f"a block of {len(value)} bytes"
    return f"{value!r:.40}"


def _remedy(value: object) -> str:
    if isinstance(value, bytes | bytearray | memoryview):
        return "read it with numberAt or utf8, or give the stream the encoding of its messages"
    return "test with has(…) first, or correct the path" if value is None else "correct the path"


def _project(below: Tree | Leaf | None, value: object, known: bool) -> object:
    if below is None:
        return _convert(value, known)
    if below is Leaf.HANDED:
        return _hand(value, known)
    if below is Leaf.ORDERED:
        return _ABSENT if isinstance(value, (bytes, bytearray, memoryview)) else _convert(value, known)
    if type(value) is dict or isinstance(value, Mapping):  # the check of the abstract class is slow
        return _members([(key, value[key], sub) for key, sub in below.items() if key in value], known)
    if isinstance(value, (list, tuple)) or _is_array(value):
        return _items(below, cast("list[object]", value), known)
    if _is_record(value):
        present = _field_names(value)
        return _members([(key, getattr(value, str(key)), sub) for key, sub in below.items() if key in present], known)
    return _convert(value, known)


def _members(members: Iterable[tuple[Step, object, Tree | Leaf | None]], known: bool) -> dict[Step, object]:
    result: dict[Step, object] = {}
    for key, value, below in members:
        kept = _project(below, value, known)
        if kept is not _ABSENT:
            result[key] = kept
    return result


def _items(below: Tree, items: list[object], known: bool) -> list[object]:
    """The list up to the last index that is read, the others null, so that what is read keeps its index."""
    indices = [step for step in below if isinstance(step, int) and step < len(items)]
    result: list[object] = [None] * (max(indices) + 1 if indices else 0)
    for index in indices:
        kept = _project(below[index], items[index], known)
        result[index] = None if kept is _ABSENT else kept
    return result


def _convert(value: object, known: bool) -> object:
    kind = type(value)
    if kind is float:
        return _ABSENT if known and value != value else value  # noqa: PLR0124 (NaN alone differs from itself)
    if kind is str:
        text = cast("str", value)
        return text.replace("\0", "␀") if "\0" in text else text
    if kind is bool:
        return value
    if value is None:
        return _ABSENT if known else None
    if kind is int:
        return integer(cast("int", value))
    if kind is list or kind is tuple:
        return [
            None if item is _ABSENT else item
            for item in (_convert(part, known) for part in cast("list[object]", value))
        ]
    if isinstance(value, Mapping):
        return {_key(key): kept for key, part in value.items() if (kept := _convert(part, known)) is not _ABSENT}
    return _convert_rare(value, known)


def _convert_rare(value: object, known: bool) -> object:
    if _is_array(value):  # numpy: before the plain types, of which its scalars are subclasses
        return _convert(value.tolist(), known)  # type: ignore[attr-defined]
    if isinstance(value, (bytes, bytearray, memoryview)):
        handle = hand(value)
        return _ABSENT if handle is None else handle
    if isinstance(value, (datetime.datetime, datetime.timedelta)):
        return value
    if _is_record(value):
        return _convert({name: getattr(value, name) for name in _field_names(value)}, known)
    for plain in (str, int, float):
        if isinstance(value, plain):  # such as a member of an enum
            return _convert(plain(plain.__str__(value)) if plain is str else plain(value), known)
    if isinstance(value, (list, tuple, set, frozenset)):
        return _convert(list(value), known)
    raise EvaluationError(f"a value of type {type(value).__name__} cannot enter an expression: decode it to plain data")


def _hand(value: object, known: bool) -> object:
    """A handle for what is large, the value itself where it is a number or a text."""
    if (
        isinstance(value, (list, tuple, Mapping))
        or (_is_array(value) and hasattr(value, "__len__"))
        or _is_record(value)
    ):
        handle = hand(value)
        if handle is not None:
            return handle
    return _convert(value, known)


def integer(value: int) -> int | float:
    """An integer as expressions have it: a double, but for those that only an integer holds."""
    if -MAX_EXACT <= value <= MAX_EXACT or not -(2**63) <= value < 2**64:
        try:
            return float(value)
        except OverflowError:
            return float("inf") if value > 0 else float("-inf")
    return value


def _key(key: object) -> object:
    if type(key) is str:
        return key.replace("\0", "␀") if "\0" in key else key
    return key.tolist() if _is_array(key) else key  # type: ignore[attr-defined]


def _is_array(value: object) -> bool:
    """Whether it is a numpy array or scalar: detected by its methods, since nothing here needs numpy itself."""
    return hasattr(value, "tolist") and hasattr(value, "dtype")


def _is_record(value: object) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _field_names(record: object) -> frozenset[str]:
    """The names of a dataclass's fields, looked up once per class: a message is decoded many times a second."""
    names = _FIELD_NAMES.get(type(record))
    if names is None:
        names = frozenset(field.name for field in dataclasses.fields(cast("type", type(record))))
        _FIELD_NAMES[type(record)] = names
    return names
