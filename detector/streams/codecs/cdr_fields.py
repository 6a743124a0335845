"""CDR: reads a few fields, by a function whose source is generated for the type and the paths (see `cdr_walk`).

It finds what rosbags finds, and makes all its checks, including those of skipped fields. A payload that fails a check
is decoded as a whole, so that the decoder reports the error.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype

from detector.engine.samples.sample import MISSING, FieldReader, Fields
from detector.streams.codecs.cdr_source import CdrSource, UnwalkableError
from detector.streams.codecs.cdr_values import PADDING
from detector.streams.codecs.cdr_walk import Tree, Walk
from detector.streams.codecs.paths import Path, complete, shortest, spread
from detector.streams.codecs.ros import RosTypes

_Walker = Callable[[Sequence[bytes], Callable[[int], None]], list[list[Any] | None]]
"""Reads payloads, and calls back with the index of each that it cannot read. Returns the values of the others by path;
None for a path that does not exist."""


@dataclass(frozen=True, slots=True)
class _Order:
    """A byte order: in an encapsulation, in struct and in numpy."""

    representation: bytes
    mark: int
    """The representation as a number that is read in this order."""
    sign: str


_LITTLE: Final = _Order(b"\x00\x01", 0x100, "<")
_BIG: Final = _Order(b"\x00\x00", 0, ">")


_REFUSED = (struct.error, IndexError, ValueError, OverflowError)
"""Exceptions of generated code for payloads that cannot be read."""


def cdr_fields(
    types: RosTypes, type_name: str, paths: Sequence[Path], decode: Callable[[bytes], Any]
) -> FieldReader | None:
    """A reader of the paths in messages of a known type; None if only `decode` can read it.

    `decode` reads a whole payload.
    """
    whole = tuple(shortest(_readable(types, type_name, path) for path in paths))
    try:
        little, big = _walkers(types, type_name, whole)
    except UnwalkableError:
        return None

    def read_fields(payloads: Sequence[bytes]) -> Fields:
        columns, left = _read(little, payloads)
        # A stream rarely has both byte orders: payloads with the most common one are read, the others are decoded as a
        # whole.
        if 2 * sum(payloads[place][:2] == _BIG.representation for place in left) > len(payloads):
            columns, left = _read(big, payloads)
        return spread(complete(payloads, columns, whole, left, decode), whole, paths)

    return read_fields


def _read(walk: _Walker, payloads: Sequence[bytes]) -> tuple[list[list[Any]], list[int]]:
    """The columns of the readable payloads, and the indices of the others."""
    left: list[int] = []
    columns = walk(payloads, left.append)
    present = len(payloads) - len(left)
    return [[MISSING] * present if column is None else column for column in columns], left


@lru_cache(maxsize=256)
def _walkers(types: RosTypes, type_name: str, paths: tuple[Path, ...]) -> tuple[_Walker, _Walker]:
    return _walker(types, type_name, paths, _LITTLE), _walker(types, type_name, paths, _BIG)


def _readable(types: RosTypes, type_name: str, path: Path) -> Path:
    """The part of the path that leads through messages: the rest is looked up in the value."""
    at: str | None = type_name
    for length, step in enumerate(path):
        if at is None:
            return path[:length]
        desc = None if step == PADDING else dict(types.fields(at)).get(str(step)) if type(step) is str else None
        if desc is None:
            return path[: length + 1]  # it does not exist
        at = str(desc[1]) if desc[0] is Nodetype.NAME else None
    return path


def _walker(types: RosTypes, type_name: str, paths: Sequence[Path], order: _Order) -> _Walker:
    """A function that reads the paths, none of which lies below another one. Raises UnwalkableError."""
    code = CdrSource(order.sign)
    walk = Walk(types, code)
    mark = code.encapsulation()
    walk.message(type_name, _tree(paths))
    code.flush()
    refuse = ["refuse(place)", "continue"]
    found = [walk.found.get(path) for path in paths]
    appended = [(at, value) for at, value in enumerate(found) if value is not None]
    source = [
        "def read(payloads, refuse):",
        *(f" column{at} = []; append{at} = column{at}.append" for at, _ in appended),
        " for place, p in enumerate(payloads):",
        "  try:",
        *(f"   {line}" for line in code.lines),
        "  except refused:",
        *(f"   {line}" for line in refuse),
        f"  if {mark} != {order.mark} or not {code.at()} <= len(p) <= {code.at(3)}:",
        *(f"   {line}" for line in refuse),
        *(f"  append{at}({value.expression})" for at, value in appended),
        f" return [{', '.join('None' if value is None else f'column{at}' for at, value in enumerate(found))}]",
    ]
    space = {**code.bound, "refused": _REFUSED, "texts": _Texts(), "frombuffer": np.frombuffer}
    try:
        # The only external text in the source are quoted names of fields.
        exec(compile("\n".join(source), f"<fields of {type_name}>", "exec"), space)  # noqa: S102
    except (SyntaxError, RecursionError, MemoryError) as error:
        raise UnwalkableError(f"{type_name} is too large") from error
    conversions = [(at, value.convert) for at, value in appended if value.convert is not None]
    return partial(_converted, space["read"], conversions) if conversions else space["read"]


def _converted(
    read: _Walker,
    conversions: Sequence[tuple[int, Callable[[Any], Any]]],
    payloads: Sequence[bytes],
    refuse: Callable[[int], None],
) -> list[list[Any] | None]:
    columns = read(payloads, refuse)
    for at, convert in conversions:
        columns[at] = list(map(convert, columns[at] or ()))
    return columns


def _tree(paths: Sequence[Path]) -> Tree:
    tree: dict[str, Any] = {}
    for path in paths:
        node = tree
        for step in path[:-1]:
            node = node.setdefault(str(step), {})
        node[str(path[-1])] = True
    return tree


class _Texts(dict[bytes, str]):
    """A cache of texts by their bytes with the terminator: most texts repeat. Raises ValueError for those that rosbags
    rejects."""

    _MOST, _LONGEST = 4096, 256

    def __missing__(self, raw: bytes) -> str:
        if not raw or raw[-1]:
            raise ValueError
        text = raw[:-1].decode()
        if len(raw) <= self._LONGEST:
            if len(self) >= self._MOST:
                self.clear()
            self[raw] = text
        return text
