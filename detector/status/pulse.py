"""Whether an event loop is still running, measured on request: no heartbeat is needed."""

from __future__ import annotations

import asyncio
import threading
import time


class LoopMonitor:
    """Schedules a callback in the loop, and measures its delay."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._lock = threading.Lock()
        self._sent: float | None = None

    def silence(self) -> float:
        """Seconds for which the callback has been overdue; 0.0 if it is not. From any thread."""
        with self._lock:
            if self._sent is None:
                self._sent = time.monotonic()
                try:
                    self._loop.call_soon_threadsafe(self._answered)
                except RuntimeError:  # closed: the process is ending
                    self._sent = None
            return 0.0 if self._sent is None else time.monotonic() - self._sent

    def _answered(self) -> None:
        with self._lock:
            self._sent = None
