"""The progress of a replay, only on a terminal, because it may take minutes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from typing import TypeVar

from rich.console import Console

from detector.engine.samples.sample import Arrival

Record = TypeVar("Record")
Span = tuple[int, int]
"""The times of a recording's first and last message, nanoseconds since the epoch."""

_EVERY = 10_000


class ProgressLine:
    """Shows a line that is removed at the end; nothing if the console is not a terminal."""

    def __init__(self, console: Console, monotonic: Callable[[], float] = time.monotonic) -> None:
        """`monotonic` returns seconds."""
        self._console = console
        self._stack = ExitStack()
        self._monotonic = monotonic
        self._spans: list[Span | None] = []
        self._watched = 0
        self._begin = monotonic()

    def __enter__(self) -> ProgressLine:
        self._status = self._console.status("reading the recording")
        if self._console.is_terminal:
            self._stack.enter_context(self._status)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def shown(self) -> bool:
        """Whether the line is visible."""
        return self._console.is_terminal

    def expect(self, spans: Sequence[Span | None]) -> None:
        """The recordings that follow, in this order; None: the duration is not known in advance."""
        self._spans = [*spans]

    def watch(self, records: Iterable[Record]) -> Iterator[Record]:
        """The records, counted while they pass."""
        for number, record in enumerate(records, start=1):
            if number % _EVERY == 0:
                self._status.update(f"{number:,} messages replayed")
            yield record

    def watch_batches(self, batches: Iterable[Sequence[Arrival]]) -> Iterator[Sequence[Arrival]]:
        """The batches of the next recording, their messages counted while they pass."""
        number, recording = 0, self._watched
        self._watched += 1
        for batch in batches:
            number += len(batch)
            self._status.update(f"{number:,} messages replayed{self._estimate(recording, batch[-1].received)}")
            yield batch

    def note(self, what: str) -> None:
        """Show the current step."""
        self._status.update(what)

    def _estimate(self, recording: int, now: int) -> str:
        """The completed share of all recordings, and the remaining time."""
        spans = [span for span in self._spans if span is not None]
        if not spans or len(spans) < len(self._spans):
            return ""
        lengths = [last - first for first, last in spans]
        done = sum(lengths[:recording]) + min(max(now - spans[recording][0], 0), lengths[recording])
        if not done or not sum(lengths):
            return ""
        part = done / sum(lengths)
        left = (self._monotonic() - self._begin) * (1 - part) / part
        return f", {part:.0%}, about {left:.0f} s left"
