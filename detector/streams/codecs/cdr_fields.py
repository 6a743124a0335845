"""CDR: reads a few fields, by a function whose source is generated for the type and the paths (see `cdr_walk`).

It returns the values that rosbags returns, and makes all its checks, including those of skipped fields. Many similar
payloads are read together (see `cdr_columns`), the others one after another. A payload that fails a check is decoded as
a whole, so that the decoder reports the error.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Final, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype

from detector.engine.samples.sample import MISSING, FieldColumn, FieldReader, Fields
from detector.streams.codecs.cdr_columns import LEAST, CdrColumns, FieldPlaces
from detector.streams.codecs.cdr_source import CdrSource, UnwalkableError
from detector.streams.codecs.cdr_values import PADDING
from detector.streams.codecs.cdr_walk import Tree, Value, Walk
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
        little, big = _readers(types, type_name, whole)
    except UnwalkableError:
        return None

    def read_fields(payloads: Sequence[bytes]) -> Fields:
        columns, left = little.read(payloads)
        # A stream rarely has both byte orders: payloads with the most common one are read, the others are decoded as a
        # whole.
        if 2 * sum(payloads[place][:2] == _BIG.representation for place in left) > len(payloads):
            columns, left = big.read(payloads)
        return spread(complete(payloads, columns, whole, left, decode), whole, paths)

    return read_fields


class _Reader(NamedTuple):
    """Reads paths in payloads of one byte order."""

    walk: _Walker
    together: CdrColumns | None
    """Reads the paths that exist in many payloads at once; None: some are neither numbers nor texts."""
    existing: Sequence[int]
    """The indices of the paths that exist."""

    def read(self, payloads: Sequence[bytes]) -> tuple[list[FieldColumn], list[int]]:
        """The columns of the readable payloads, and the indices of the others."""
        if self.together is None or len(payloads) < LEAST:
            return self._walked(payloads)
        rows, values = self.together.read(payloads)
        others = np.delete(np.arange(len(payloads)), rows)
        columns, refused = self._walked([payloads[place] for place in others.tolist()])
        order = np.argsort(np.concatenate([rows, np.delete(others, refused)])) if len(others) else rows
        read = dict(zip(self.existing, values, strict=True))
        for at, column in enumerate(columns):
            if at not in read:
                columns[at] = [MISSING] * len(order)
            elif len(others):
                walked = np.fromiter(column, object, len(column))
                columns[at] = np.concatenate([read[at].astype(object), walked])[order].tolist()
            else:
                columns[at] = read[at] if read[at].dtype == np.float64 else read[at].tolist()
        return columns, others[refused].tolist()

    def _walked(self, payloads: Sequence[bytes]) -> tuple[list[FieldColumn], list[int]]:
        """The same, one payload after another."""
        left: list[int] = []
        columns = self.walk(payloads, left.append)
        present = len(payloads) - len(left)
        return [[MISSING] * present if column is None else column for column in columns], left


@lru_cache(maxsize=256)
def _readers(types: RosTypes, type_name: str, paths: tuple[Path, ...]) -> tuple[_Reader, _Reader]:
    return _reader(types, type_name, paths, _LITTLE), _reader(types, type_name, paths, _BIG)


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


def _reader(types: RosTypes, type_name: str, paths: Sequence[Path], order: _Order) -> _Reader:
    """Reads the paths, none of which lies below another one. Raises UnwalkableError."""
    source, found = _walk(types, type_name, paths, order, noting=False)
    appended = [(at, value) for at, value in enumerate(found) if value is not None]
    refuse = ["refuse(place)", "continue"]
    lines = [
        "def read(payloads, refuse):",
        *(f" column{at} = []; append{at} = column{at}.append" for at, _ in appended),
        " for place, p in enumerate(payloads):",
        "  try:",
        *(f"   {line}" for line in source.lines),
        "  except refused:",
        *(f"   {line}" for line in refuse),
        f"  if {source.wrong(order.mark)}:",
        *(f"   {line}" for line in refuse),
        *(f"  append{at}({value.expression})" for at, value in appended),
        f" return [{', '.join('None' if value is None else f'column{at}' for at, value in enumerate(found))}]",
    ]
    texts = _Texts()
    walk = _compiled(type_name, lines, source, texts)
    conversions = [(at, value.convert) for at, value in appended if value.convert is not None]
    together = _together(types, type_name, paths, order, texts)
    return _Reader(
        partial(_converted, walk, conversions) if conversions else walk, together, [at for at, _ in appended]
    )


def _together(
    types: RosTypes, type_name: str, paths: Sequence[Path], order: _Order, texts: _Texts
) -> CdrColumns | None:
    """Reads the paths that exist in many payloads at once; None if some are neither numbers nor texts."""
    source, found = _walk(types, type_name, paths, order, noting=True)
    existing = [value for value in found if value is not None]
    places = [value.place for value in existing if value.place is not None]
    if len(places) < len(existing):
        return None
    lines = [
        "def read(p):",
        " lengths, spans = [], []",
        *(f" {line}" for line in source.lines),
        f" if {source.wrong(order.mark)}: raise IndexError",
        f" return Places(lengths, spans, [{', '.join(f'({begin}, {end})' for begin, end in places)}])",
    ]
    kinds = [np.dtype(order.sign + value.form) if value.form else None for value in existing]
    return CdrColumns(_compiled(type_name, lines, source, texts), _REFUSED, kinds, texts)


def _walk(
    types: RosTypes, type_name: str, paths: Sequence[Path], order: _Order, *, noting: bool
) -> tuple[CdrSource, list[Value | None]]:
    """The source that walks through a payload, and by path the value that it reads."""
    source = CdrSource(order.sign, noting)
    walk = Walk(types, source)
    source.encapsulation()
    walk.message(type_name, _tree(paths))
    source.flush()
    return source, [walk.found.get(path) for path in paths]


def _compiled(type_name: str, lines: Sequence[str], source: CdrSource, texts: _Texts) -> Any:
    """The function `read` that these lines define."""
    space = {**source.bound, "refused": _REFUSED, "texts": texts, "frombuffer": np.frombuffer, "Places": FieldPlaces}
    try:
        # The only external text in the source are quoted names of fields.
        exec(compile("\n".join(lines), f"<fields of {type_name}>", "exec"), space)  # noqa: S102
    except (SyntaxError, RecursionError, MemoryError) as error:
        raise UnwalkableError(f"{type_name} is too large") from error
    return space["read"]


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
    """A cache of texts by their bytes with the terminator, as most repeat. Raises ValueError where rosbags does."""

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
