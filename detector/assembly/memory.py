"""Memory: reference cycles are looked for less often than Python would, and what is free goes back to the system.

A sample is a tuple, and by default every 700 new ones start a search for cycles, although they never form any. That
cost as much as receiving and inserting them (`benchmarks/intake_rate.py`). But libraries do leave cycles behind
(paho-mqtt, some with each message), and with rare searches they add up to ten megabytes unnoticed.

And the C library gives each thread a heap of its own that it shrinks from its end alone: one small piece at the end
keeps megabytes, so that a detector seems to grow for hours although it uses no more (`benchmarks/soak.py`).
"""

from __future__ import annotations

import ctypes
import gc
import time
from collections.abc import Callable

_YOUNG = 100_000
"""Number of new containers that starts a search among the young ones."""

_SWEEP, _TRIM = 5.0, 60.0
"""Seconds after which the young ones are searched in any case, and free memory is given back: both milliseconds."""


def tune_garbage_collection() -> None:
    """Let Python look for reference cycles less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(_YOUNG, 20, 50)


class Sweeper:
    """Searches the young containers and gives back what is free, from time to time."""

    def __init__(self) -> None:
        now = time.monotonic()
        self._trim = _trimming()
        self._sweep_due, self._trim_due = now + _SWEEP, now + _TRIM

    def look(self) -> None:
        """Do what it is time for."""
        now = time.monotonic()
        if now >= self._sweep_due:
            gc.collect(0)
            self._sweep_due = now + _SWEEP
        if now >= self._trim_due:
            self._trim(0)
            self._trim_due = now + _TRIM


def _trimming() -> Callable[[int], object]:
    """glibc's `malloc_trim`; C libraries without it (musl, macOS) give memory back by themselves."""
    trim: Callable[[int], object] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
    return trim or (lambda _: None)
