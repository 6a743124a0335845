"""JSON lines: one message per line, `{"t": <ns>, "key": "vehicles/car7/pose", "value": {…}}`, in the order of `t`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from detector.replay.batches import Batch, Channel
from detector.replay.message import OnCut, RecordingError, Truncation, Wanted, topic_key

EXAMPLE = '{"t": 1700000000000000000, "key": "vehicles/car7/pose", "value": {"x": 1.5}}'

_BLOCK = 1 << 17
"""Approximate number of bytes of lines in a batch."""
_TAIL = 1 << 16
"""Number of bytes at the end of a file in which the last line is searched."""


class _Line(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    t: int
    key: str
    value: msgspec.Raw


_read = msgspec.json.Decoder(_Line).decode
_UNREADABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


class _Block(NamedTuple):
    """The readable lines, up to the first unreadable one."""

    lines: list[_Line]
    numbers: Sequence[int]
    """The number of each line."""
    unreadable: tuple[int, bytes, Exception] | None = None
    """Number, text and error of the first unreadable line."""


def read_json_lines(path: Path, wanted: Wanted, on_cut: OnCut) -> Iterator[Batch]:
    """The messages in the lines; their values stay text. Empty lines are skipped.

    An incomplete last line is a cut. Raises RecordingError, with file and line, for an invalid line and if `t` goes
    back.
    """
    channels: dict[str, Channel | None] = {}
    last = messages = 0
    number = 1
    with path.open("rb") as file:
        while texts := file.readlines(_BLOCK):
            block = _decoded(texts, number)
            number += len(texts)
            wrong = _first_wrong(block.lines, last)
            lines = block.lines if wrong is None else block.lines[: wrong.position]
            if lines:
                last = lines[-1].t
                batch = _batch(lines, wanted, channels)
                if batch.times:
                    messages += len(batch.times)
                    yield batch
            if wrong is not None:
                raise RecordingError(f"{path}:{block.numbers[wrong.position]}: {wrong.problem}")
            if block.unreadable is not None:
                where, text, error = block.unreadable
                if not text.endswith(b"\n"):
                    on_cut(Truncation(path, messages, f"line {where} has no end"))
                    return
                raise RecordingError(f"{path}:{where}: {error}: write each line as {EXAMPLE}") from error


def json_lines_span(path: Path) -> tuple[int, int] | None:
    """The times of the first line and of the last complete one; None if one cannot be read."""
    with path.open("rb") as file:
        first = file.readline()
        file.seek(max(0, file.seek(0, 2) - _TAIL))
        ends = [line for line in file.read().split(b"\n")[:-1] if line.strip()]
    try:
        return (_read(first).t, _read(ends[-1]).t) if ends else None
    except _UNREADABLE:
        return None


def _decoded(texts: Sequence[bytes], number: int) -> _Block:
    """`number` is the number of the first line."""
    try:
        return _Block(list(map(_read, texts)), range(number, number + len(texts)))
    except _UNREADABLE:
        pass  # or empty: check each line
    block = _Block([], numbers := [])
    for where, text in enumerate(texts, start=number):
        if text.isspace():
            continue
        try:
            block.lines.append(_read(text))
        except _UNREADABLE as error:
            return block._replace(unreadable=(where, text, error))
        numbers.append(where)
    return block


class _Wrong(NamedTuple):
    position: int
    problem: str


def _first_wrong(lines: Sequence[_Line], last: int) -> _Wrong | None:
    """The first line whose time goes back from the previous one, which is `last` at first, or that has no key."""
    times = [last, *[line.t for line in lines]]
    if sorted(times) == times and all(map(topic_key, {line.key for line in lines})):
        return None
    for position, (line, previous) in enumerate(zip(lines, times[:-1], strict=True)):
        if line.t < previous:
            back = f"t decreases from {previous} to {line.t}: sort the lines by t"
            return _Wrong(position, "t is negative" if line.t < 0 else back)
        if not topic_key(line.key):
            return _Wrong(position, f"key is empty: write each line as {EXAMPLE}")
    return None


def _batch(lines: Sequence[_Line], wanted: Wanted, channels: dict[str, Channel | None]) -> Batch:
    """The wanted messages, if any; `channels` has the channels of known keys, None for unwanted ones."""
    keys = [line.key for line in lines]
    there = set(keys)
    for key in there - channels.keys():
        channels[key] = Channel(topic_key(key), "json", None) if wanted(topic_key(key)) else None
    kept = lines
    if any(channels[key] is None for key in there):
        kept = [line for line in lines if channels[line.key] is not None]
    return Batch(
        [line.t for line in kept],
        [channel for line in kept if (channel := channels[line.key]) is not None],
        [bytes(line.value) for line in kept],
    )
