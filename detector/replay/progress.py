"""How far a replay is: on a terminal only, since it may take minutes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from typing import TypeVar

from rich.console import Console

Record = TypeVar("Record")

_EVERY = 10_000


class Progress:
    """Shows a line that is taken away at the end; nothing where the console is no terminal."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._stack = ExitStack()

    def __enter__(self) -> Progress:
        self._status = self._console.status("reading the recording")
        if self._console.is_terminal:
            self._stack.enter_context(self._status)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def watch(self, records: Iterable[Record]) -> Iterator[Record]:
        """The records, counted on their way."""
        for number, record in enumerate(records, start=1):
            if number % _EVERY == 0:
                self._show(number)
            yield record

    def watch_batches(self, batches: Iterable[Sequence[Record]]) -> Iterator[Sequence[Record]]:
        """The batches, their records counted on their way."""
        number = 0
        for batch in batches:
            number += len(batch)
            self._show(number)
            yield batch

    def _show(self, number: int) -> None:
        self._status.update(f"{number:,} messages replayed")
