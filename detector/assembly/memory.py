"""Memory: searches for reference cycles less often than Python would, and returns free memory to the system.

A sample is a tuple, and by default every 700 new tuples trigger a search for cycles, although samples never form any.
That cost as much as receiving and inserting them (`benchmarks/intake_rate.py`). But libraries do create cycles
(paho-mqtt, some with each message), and with rare searches these grow to ten megabytes unnoticed.

Also, the C library gives each thread a separate heap that it shrinks only from its end: one small allocation at the end
keeps megabytes, so a detector seems to grow for hours although it uses no more (`benchmarks/soak.py`).
"""

from __future__ import annotations

import ctypes
import gc
import time
from collections.abc import Callable

_YOUNG = 100_000
"""Number of new containers that triggers a search of the young generation."""

_SWEEP, _TRIM = 5.0, 60.0
"""Periods in seconds of the search of the young generation and of trimming; each takes milliseconds."""


def tune_garbage_collection() -> None:
    """Make Python search for reference cycles less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(_YOUNG, 20, 50)


class Sweeper:
    """Searches the young generation and trims the heap from time to time."""

    def __init__(self) -> None:
        now = time.monotonic()
        self._trim = _trimming()
        self._sweep_due, self._trim_due = now + _SWEEP, now + _TRIM

    def run_due(self) -> None:
        """Collect garbage and trim the heap, if due."""
        now = time.monotonic()
        if now >= self._sweep_due:
            gc.collect(0)
            self._sweep_due = now + _SWEEP
        if now >= self._trim_due:
            self._trim(0)
            self._trim_due = now + _TRIM


def _trimming() -> Callable[[int], object]:
    """glibc's `malloc_trim`; C libraries without it (musl, macOS) return memory by themselves."""
    trim: Callable[[int], object] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
    return trim or (lambda _: None)
