"""A work queue of names: each is queued at most once, and processed by one worker at a time."""

from __future__ import annotations

import asyncio


class WorkQueue:
    """A queue of names for one event loop, first in, first out.

    Its size is bounded by the number of distinct names. A name that is added while it is being processed is queued
    again afterwards: it may have changed after the worker read it.
    afterwards: it may have changed after the worker looked.
    """

    def __init__(self) -> None:
        self._waiting: dict[str, None] = {}
        self._working: set[str] = set()
        self._again: set[str] = set()
        self._some = asyncio.Event()
        self._none = asyncio.Event()
        self._none.set()

    def __len__(self) -> int:
        """Number of names that are queued or being processed."""
        return len(self._waiting) + len(self._working)

    def add(self, name: str) -> None:
        """Enqueue a name."""
        if name in self._working:
            self._again.add(name)
        else:
            self._waiting[name] = None
            self._some.set()
        self._none.clear()

    async def take(self) -> str:
        """Wait for the next name; call `done` with it afterwards."""
        while not self._waiting:
            self._some.clear()
            await self._some.wait()
        name = next(iter(self._waiting))
        del self._waiting[name]
        self._working.add(name)
        return name

    def done(self, name: str) -> None:
        """Mark a taken name as processed."""
        self._working.discard(name)
        if name in self._again:
            self._again.discard(name)
            self.add(name)
        elif not len(self):
            self._none.set()

    async def empty(self) -> None:
        """Wait until no name is queued or being processed."""
        await self._none.wait()
