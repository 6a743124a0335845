"""How far a replay is: on a terminal only, since it may take minutes."""

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
    """Shows a line that is taken away at the end; nothing where the console is no terminal."""

    def __init__(self, console: Console, monotonic: Callable[[], float] = time.monotonic) -> None:
        """`monotonic` gives seconds."""
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
        """Whether anybody sees it."""
        return self._console.is_terminal

    def expect(self, spans: Sequence[Span | None]) -> None:
        """The recordings that follow, in this order; None: how long one is cannot be seen beforehand."""
        self._spans = [*spans]

    def watch(self, records: Iterable[Record]) -> Iterator[Record]:
        """The records, counted on their way."""
        for number, record in enumerate(records, start=1):
            if number % _EVERY == 0:
                self._status.update(f"{number:,} messages replayed")
            yield record

    def watch_batches(self, batches: Iterable[Sequence[Arrival]]) -> Iterator[Sequence[Arrival]]:
        """The batches of the next recording, their messages counted on their way."""
        number, recording = 0, self._watched
        self._watched += 1
        for batch in batches:
            number += len(batch)
            self._status.update(f"{number:,} messages replayed{self._estimate(recording, batch[-1].received)}")
            yield batch

    def note(self, what: str) -> None:
        """Show what is done now."""
        self._status.update(what)

    def _estimate(self, recording: int, now: int) -> str:
        """How much of all recordings is done, and how long the rest takes."""
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
