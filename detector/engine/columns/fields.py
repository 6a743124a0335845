"""Reads the fields that expressions name from messages and from their items."""

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
    LinkedSample,
    PreviousSample,
    Sample,
)
from wayside.expressions import Path
from wayside.expressions.columns.values import Column, Texts, column_of

OF_A_SAMPLE = frozenset(("msg", "item", "before"))
"""The variables whose fields are read here."""


class FoundFields(NamedTuple):
    """The fields of some samples."""

    columns: list[Column]
    """By path."""
    errors: dict[int, DecodeError]
    """The samples that cannot be read, by their indices."""
    odd: frozenset[int]
    """The indices of the samples that an expression needs as a whole: see `Fields.odd`."""


class SampleFields:
    """Reads the same fields of many samples of a stream."""

    def __init__(self, stream: str, decoder: Decoder, items: Items, paths: Sequence[Path]) -> None:
        """`paths` begin with one of the variables in OF_A_SAMPLE, and have at least one more part."""
        self._stream = stream
        self._items = items
        self._paths = paths
        self._of = {name: [path[1:] for path in paths if path[0] == name] for name in OF_A_SAMPLE}
        self._messages = _reader(decoder, self._of["msg"])
        self._before = _reader(decoder, self._of["before"])

    def read(self, samples: Sequence[Sample], texts: Texts) -> FoundFields:
        """The fields of these samples."""
        errors: dict[int, DecodeError] = {}
        odd: set[int] = set()
        shared = self._stream in self._items
        found: dict[str, list[Column]] = {name: [] for name in OF_A_SAMPLE}
        if self._of["msg"] and shared:
            found["msg"] = self._shared(samples, texts, odd)
        elif self._of["msg"]:
            fields = self._messages([sample.payload for sample in samples])
            errors.update(fields.errors)
            odd.update(fields.odd)
            found["msg"] = [column_of(values, texts) for values in fields.columns]
        if self._of["item"]:
            items = [(sample.payload, sample.place) if isinstance(sample, Item) else None for sample in samples]
            found["item"] = [column_of(values, texts) for values in self._walked(items, self._of["item"], odd)]
        if self._of["before"]:
            before = [sample.before if isinstance(sample, LinkedSample | Item) else None for sample in samples]
            odd.update(at for at, each in enumerate(before) if each is None)  # CEL defines that it is unknown
            if shared:
                items = [None if each is None else (each.payload, each.place) for each in before]
                columns = self._walked(items, self._of["before"], odd)
            else:
                columns = self._read_before(before, odd)
            found["before"] = [column_of(values, texts) for values in columns]
        ready = {name: iter(columns) for name, columns in found.items()}
        return FoundFields([next(ready[str(path[0])]) for path in self._paths], errors, frozenset(odd))

    def _read_before(self, before: Sequence[PreviousSample | None], odd: set[int]) -> list[list[Any]]:
        """The fields of the previous messages; MISSING where there is none, or where it cannot be read."""
        there = [at for at, each in enumerate(before) if each is not None]
        fields = self._before([each.payload for each in before if each is not None])
        odd.update(there[at] for at in (*fields.odd, *fields.errors))
        columns: list[list[Any]] = []
        for values in fields.columns:
            column: list[Any] = [MISSING] * len(before)
            for at, value in zip(there, values.tolist() if isinstance(values, np.ndarray) else values, strict=True):
                column[at] = value
            columns.append(column)
        return columns

    def _shared(self, samples: Sequence[Sample], texts: Texts, odd: set[int]) -> list[Column]:
        """The fields of messages that several samples share. Each is read once; all were readable on receipt."""
        places: dict[bytes, int] = {}
        which = np.array([places.setdefault(sample.payload, len(places)) for sample in samples], np.int64)
        fields = self._messages([*places])
        odd.update(np.flatnonzero(np.isin(which, np.array(fields.odd, np.int64))).tolist())
        return [_taken(column_of(values, texts), which) for values in fields.columns]

    def _walked(
        self, items: Sequence[tuple[bytes, int] | None], paths: Sequence[Path], odd: set[int]
    ) -> list[list[Any]]:
        """The fields of items; each item is given by its message and its index in the list."""
        lists: dict[bytes, list[Any]] = {}
        values: list[Any] = []
        for item in items:
            if item is None:
                values.append(MISSING)
                continue
            payload, place = item
            listed = lists.get(payload)
            if listed is None:
                listed = lists[payload] = self._items.read(self._stream, payload).items
            values.append(listed[place])
        return [walked(values, path, odd) for path in paths]


def _reader(decoder: Decoder, paths: Sequence[Path]) -> FieldReader:
    read = decoder.field_reader(paths) if isinstance(decoder, FieldDecoder) and paths else None
    return read or whole(decoder, paths)


def walked(values: Sequence[Any], path: Path, odd: set[int]) -> list[Any]:
    """The value at the path below each value, or MISSING; adds the indices of values as in `Fields.odd`."""
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
    """The column's values at these indices."""
    return Column(
        column.values[at],
        None if column.tags is None else column.tags[at],
        None if column.others is None else column.others[at],
    )
