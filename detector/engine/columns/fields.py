"""Reads the fields of samples that expressions name: of messages, and of their items."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from detector.engine.buffering.items import Items
from detector.engine.samples.sample import (
    MISSING,
    DecodeError,
    Decoder,
    FieldDecoder,
    FieldReader,
    Fields,
    Item,
    Sample,
)
from wayside.expressions import Path
from wayside.expressions.columns.values import Column, Texts, column_of

OF_A_SAMPLE = frozenset(("msg", "item"))
"""The variables whose fields are read here."""


class Found(NamedTuple):
    """The fields of some samples."""

    columns: list[Column]
    """By path."""
    errors: dict[int, DecodeError]
    """The samples that cannot be read, by their places."""
    odd: frozenset[int]
    """The places of the samples of which an expression needs the whole: see `Fields.odd`."""


class SampleFields:
    """Reads the same fields of many samples of a stream."""

    def __init__(self, stream: str, decoder: Decoder, items: Items, paths: Sequence[Path]) -> None:
        """`paths` begin with one of the variables OF_A_SAMPLE, and are longer than that."""
        self._stream = stream
        self._items = items
        self._paths = paths
        of_messages = [path[1:] for path in paths if path[0] == "msg"]
        self._of_items = [path[1:] for path in paths if path[0] == "item"]
        read = decoder.field_reader(of_messages) if isinstance(decoder, FieldDecoder) and of_messages else None
        self._read_messages = read or whole(decoder, of_messages)
        self._some = bool(of_messages)

    def read(self, samples: Sequence[Sample], texts: Texts) -> Found:
        """The fields of these samples."""
        errors: dict[int, DecodeError] = {}
        odd: set[int] = set()
        if not self._some:
            of_messages: list[Column] = []
        elif self._stream in self._items:
            of_messages = self._shared(samples, texts, odd)
        else:
            fields = self._read_messages([sample.payload for sample in samples])
            errors.update(fields.errors)
            odd.update(fields.odd)
            of_messages = [column_of(values, texts) for values in fields.columns]
        of_items = iter([column_of(values, texts) for values in self._walked(samples, odd)])
        messages = iter(of_messages)
        columns = [next(of_items if path[0] == "item" else messages) for path in self._paths]
        return Found(columns, errors, frozenset(odd))

    def _shared(self, samples: Sequence[Sample], texts: Texts, odd: set[int]) -> list[Column]:
        """The fields of messages that several samples share, each read once. All could be read as they came."""
        places: dict[bytes, int] = {}
        which = np.array([places.setdefault(sample.payload, len(places)) for sample in samples], np.int64)
        fields = self._read_messages([*places])
        odd.update(np.flatnonzero(np.isin(which, np.array(fields.odd, np.int64))).tolist())
        return [_taken(column_of(values, texts), which) for values in fields.columns]

    def _walked(self, samples: Sequence[Sample], odd: set[int]) -> list[list[Any]]:
        if not self._of_items:
            return []
        lists: dict[bytes, list[Any]] = {}
        items: list[Any] = []
        for sample in samples:
            listed = lists.get(sample.payload)
            if listed is None:
                listed = lists[sample.payload] = self._items.read(self._stream, sample.payload).items
            items.append(listed[sample.place] if isinstance(sample, Item) else MISSING)
        return [walked(items, path, odd) for path in self._of_items]


def walked(values: Sequence[Any], path: Path, odd: set[int]) -> list[Any]:
    """What the path leads to below each value, or MISSING; adds the places of values as in `Fields.odd`."""
    found = list(values)
    for step in path:
        found = [
            value.get(step, MISSING) if type(value) is dict else _below(value, step, at, odd)
            for at, value in enumerate(found)
        ]
    return found


def _below(value: Any, step: str | int, at: int, odd: set[int]) -> Any:
    if isinstance(value, list) and isinstance(step, int):
        return value[step] if 0 <= step < len(value) else MISSING
    if isinstance(value, Mapping):
        return value.get(step, MISSING)
    if value is not MISSING:
        odd.add(at)
    return MISSING


def whole(decoder: Decoder, paths: Sequence[Path]) -> FieldReader:
    """Reads fields by decoding each message as a whole."""

    def read(payloads: Sequence[bytes]) -> Fields:
        messages: list[Any] = []
        errors: dict[int, DecodeError] = {}
        odd: set[int] = set()
        for at, payload in enumerate(payloads):
            try:
                messages.append(decoder.decode(payload))
            except DecodeError as error:
                messages.append(MISSING)
                errors[at] = error
        return Fields([walked(messages, path, odd) for path in paths], errors, sorted(odd))

    return read


def _taken(column: Column, at: np.ndarray[Any, np.dtype[np.int64]]) -> Column:
    """The column's values at these places."""
    return Column(
        column.values[at],
        None if column.tags is None else column.tags[at],
        None if column.others is None else column.others[at],
    )
