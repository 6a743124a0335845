"""CDR: reads fields of many payloads at once, as strided views of the payloads joined together.

In payloads of equal length, whose texts and sequences have equal lengths, each field has the same place. A generated
function (see `cdr_walk`) finds the places in one payload, and the other payloads with its lengths are read there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wayside.expressions.numbers import MAX_EXACT, as_double

LEAST = 128
"""Minimum number of payloads with equal places: fewer are read faster one by one."""
_LONGEST = 4096
"""Maximum length of a payload: copying a longer one costs more than reading it by itself."""
_BLOCK = 1 << 20
"""Bytes that are joined at once, approximately."""
_MOST_COMPARED = 64
"""Maximum number of texts and lengths in a payload: each is compared over all payloads."""
_MOST_TRIES = 8
"""Maximum number of payloads of a block in which the places are looked for."""

_LENGTH = 4
"""Bytes of the length of a text or sequence."""

Rows = NDArray[np.int64]
Values = NDArray[Any]
"""Doubles, or objects: the values as decoded."""


class FieldPlaces(NamedTuple):
    """The places in a payload: for each part, its first byte and the byte after its last one."""

    lengths: Sequence[int]
    """The first bytes of the lengths of texts and sequences."""
    texts: Sequence[tuple[int, int]]
    """All texts, with their terminators."""
    fields: Sequence[tuple[int, int]]
    """The requested fields."""


class CdrColumns(NamedTuple):
    """Reads fields, all of them numbers or texts, of payloads of one type and byte order."""

    locate: Callable[[bytes], FieldPlaces]
    """Raises one of `refused` for a payload that cannot be read."""
    refused: tuple[type[Exception], ...]
    kinds: Sequence[np.dtype[Any] | None]
    """The number type of each field; None: a text."""
    texts: Mapping[bytes, str]
    """The text in some bytes with their terminator; raises one of `refused` if they are none."""

    def read(self, payloads: Sequence[bytes]) -> tuple[Rows, list[Values]]:
        """The ascending indices of payloads that can be read together, and their values by field.

        The other payloads are few of a kind, or long, or cannot be read.
        """
        rows: list[Rows] = []
        columns: list[list[Values]] = [[] for _ in self.kinds]
        for length, own, alike in _by_length(payloads):
            step = max(LEAST, _BLOCK // length)
            for begin in range(0, len(own), step):
                block = _Block(b"".join(alike[begin : begin + step]), len(own[begin : begin + step]), length)
                for found, values in self._alike(block):
                    rows.append(own[begin : begin + step][found])
                    for column, some in zip(columns, values, strict=True):
                        column.append(some)
        if not rows:
            return np.zeros(0, np.int64), [np.zeros(0) for _ in columns]
        together, merged = np.concatenate(rows), [np.concatenate(column) for column in columns]
        if (together[1:] > together[:-1]).all():
            return together, merged
        order = np.argsort(together)
        return together[order], [column[order] for column in merged]

    def _alike(self, block: _Block) -> Iterator[tuple[Rows | slice, list[Values]]]:
        """The rows with equal places, and their values, for each of the places that are common."""
        left = np.ones(block.rows, np.bool_)
        for _ in range(_MOST_TRIES):
            if np.count_nonzero(left) < LEAST:
                return
            first = int(left.argmax())
            left[first] = False
            try:
                places = self.locate(block.payload(first))
            except self.refused:
                continue
            if len(places.lengths) + len(places.texts) > _MOST_COMPARED:
                return
            alike = block.equal(0, 2, first)  # the byte order
            for place in places.lengths:
                alike &= block.equal(place, place + _LENGTH, first)
            left &= ~alike
            for begin, end in places.texts:
                self._check(block, begin, end, first, alike)
            rows = slice(None) if alike.all() else np.flatnonzero(alike)
            columns = zip(self.kinds, places.fields, strict=True)
            yield rows, [self._values(block, kind, begin, end, rows) for kind, (begin, end) in columns]

    def _check(self, block: _Block, begin: int, end: int, first: int, alike: NDArray[np.bool_]) -> None:
        """Remove the rows whose bytes are no text. Those of the first are one."""
        others = np.flatnonzero(alike & ~block.equal(begin, end, first))
        if not len(others):
            return
        raw = block.raw(begin, end)[others].tolist()
        known = {each: self._is_text(each) for each in set(raw)}
        alike[others] = [known[each] for each in raw]

    def _is_text(self, raw: bytes) -> bool:
        try:
            self.texts[raw]
        except self.refused:
            return False
        return True

    def _values(self, block: _Block, kind: np.dtype[Any] | None, begin: int, end: int, rows: Rows | slice) -> Values:
        if kind is None:
            found = [self.texts[raw] for raw in block.raw(begin, end)[rows].tolist()]
            return np.fromiter(found, object, len(found))
        values = block.view(kind, begin)[rows]
        if kind.kind == "b":
            return values.astype(object)
        if kind.kind in "iu" and kind.itemsize == 8 and ((values > MAX_EXACT) | (values < -MAX_EXACT)).any():
            return np.fromiter(map(as_double, values.tolist()), object, len(values))
        return values.astype(np.float64)


def _by_length(payloads: Sequence[bytes]) -> Iterator[tuple[int, Rows, Sequence[bytes]]]:
    """The lengths that are frequent, each with its payloads and their indices."""
    first = len(payloads[0])
    if set(map(len, payloads)) == {first}:
        if 0 < first <= _LONGEST:
            yield first, np.arange(len(payloads)), payloads
        return
    lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
    for length, count in Counter(lengths.tolist()).items():
        if count >= LEAST and 0 < length <= _LONGEST:
            rows = np.flatnonzero(lengths == length)
            yield length, rows, [payloads[row] for row in rows.tolist()]


class _Block(NamedTuple):
    """Payloads of equal length, one after another."""

    joined: bytes
    rows: int
    length: int

    def payload(self, row: int) -> bytes:
        return self.joined[row * self.length : (row + 1) * self.length]

    def view(self, kind: np.dtype[Any], begin: int) -> NDArray[Any]:
        """By row, the value at this place of the payload."""
        return np.ndarray((self.rows,), kind, self.joined, begin, (self.length,))

    def raw(self, begin: int, end: int) -> NDArray[np.void]:
        return self.view(np.dtype((np.void, end - begin)), begin)

    def equal(self, begin: int, end: int, row: int) -> NDArray[np.bool_]:
        """The rows that have the same bytes there as this row."""
        values = self.raw(begin, end)
        equal: NDArray[np.bool_] = values == values[row]
        return equal
