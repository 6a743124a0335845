"""Whether an event loop still runs, found out by whoever asks: nothing has to beat meanwhile."""

from __future__ import annotations

import asyncio
import threading
import time


class Pulse:
    """Leaves word with the loop, and counts how long that is not answered."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        self._asked: float | None = None

    def silence(self) -> float:
        """Seconds for which the loop has owed an answer; 0.0 where it owes none. From any thread."""
        with self._lock:
            if self._asked is None:
                self._asked = time.monotonic()
                try:
                    self._loop.call_soon_threadsafe(self._answered)
                except RuntimeError:  # closed: the process is ending
                    self._asked = None
            return 0.0 if self._asked is None else time.monotonic() - self._asked

    def _answered(self) -> None:
        with self._lock:
            self._asked = None
