"""Projects a message to the values that an expression reads, converted to the types of CEL.

CEL would convert the whole message, at a cost that grows with its size, and would fail for one unsupported member. So
the paths that an expression reads form a tree, and only the values on this tree are copied and converted:

* integers up to 2^53 become doubles; larger ones stay integers, which support only equality, `in` and order;
* numpy arrays and tuples become lists, numpy scalars plain values, dataclasses (decoded ROS messages) maps;
* NUL, at which CEL would truncate a string, becomes `␀` (U+2400);
* bytes, which CEL would truncate as well, become handles (see `handles`), and so do lists and maps that are only
  arguments of functions.

With `known=True`, null and NaN are absent too. They are left out of maps, so that reading them is an error in CEL,
which `&&`, `||` and `?:` treat as unknown. In lists they become null, so that no index shifts; comparisons of their
order and arithmetic with them are then unknown.
"""

from __future__ import annotations

import dataclasses
import datetime
import enum
from collections.abc import Iterable, Mapping
from typing import Final, cast

from wayside.expressions.errors import EvaluationError
from wayside.expressions.handles import handle_of
from wayside.expressions.numbers import MAX_EXACT
from wayside.expressions.syntax import Path, Step
from wayside.names import did_you_mean

_ABSENT: Final = object()


class Leaf(enum.Enum):
    """How the value at the end of a path is read, if not as a whole."""

    HANDED = "handed"
    """As a handle, if it is a list, a map or bytes."""
    ORDERED = "ordered"
    """As a whole, but bytes are absent: a handle would be greater than every number."""


Tree = Mapping[Step, "Tree | Leaf | None"]
"""The parts of a value that are read; None: the whole value."""

_FIELD_NAMES: Final[dict[type, frozenset[str]]] = {}


def tree(paths: Iterable[Path], leaves: Mapping[Path, Leaf]) -> Tree:
    """The tree of the given paths; a path replaces all longer ones. `leaves` defines how some are read."""
    root: dict[Step, Tree | Leaf | None] = {}
    for path in sorted(paths, key=len):  # shorter paths first: they replace the longer ones
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
    """The part of `values` that is read. Raises EvaluationError for a value of an unsupported type."""
    result: dict[str, object] = {}
    for name, below in read.items():
        if isinstance(name, str) and name in values:
            value = _project(below, values[name], known)
            if value is not _ABSENT:
                result[name] = value
    return result


def normalise(value: object) -> object:
    """A whole decoded value in the types of CEL.

    Null and NaN are kept; bytes become null in lists, and absent in maps.
    """
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
    """The list up to the last index that is read; items that are not read are null, to keep the indices."""
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
    if _is_array(value):  # before the plain types, since some numpy scalars are subclasses of these
        return _convert(value.tolist(), known)  # type: ignore[attr-defined]
    if isinstance(value, (bytes, bytearray, memoryview)):
        handle = handle_of(value)
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
    """A handle for a list, a map or bytes; any other value is converted."""
    if (
        isinstance(value, (list, tuple, Mapping))
        or (_is_array(value) and hasattr(value, "__len__"))
        or _is_record(value)
    ):
        handle = handle_of(value)
        if handle is not None:
            return handle
    return _convert(value, known)


def integer(value: int) -> int | float:
    """An integer in the type of expressions: a double, or an integer if a double cannot represent it exactly."""
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
    """Whether it is a numpy array or scalar. It is detected by its attributes, so that numpy need not be imported."""
    return hasattr(value, "tolist") and hasattr(value, "dtype")


def _is_record(value: object) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _field_names(record: object) -> frozenset[str]:
    """The names of a dataclass's fields, looked up once per class, since projections are frequent."""
    names = _FIELD_NAMES.get(type(record))
    if names is None:
        names = frozenset(field.name for field in dataclasses.fields(cast("type", type(record))))
        _FIELD_NAMES[type(record)] = names
    return names
