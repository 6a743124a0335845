"""Reference cycles: looked for less often than Python would, and yet never left lying.

A sample is a tuple, and by default every 700 new ones start a search for cycles, although they never form any. That
cost as much as receiving and inserting them (`benchmarks/intake_rate.py`). But libraries do leave cycles behind
(paho-mqtt, some with each message), and with rare searches they add up to ten megabytes before anybody looks.
"""

from __future__ import annotations

import gc
import time

_YOUNG = 100_000
"""So many new containers start a search among the young ones."""

_EVERY = 5.0
"""Seconds after which the young ones are searched in any case: a few milliseconds, since they are few then."""


def tune_garbage_collection() -> None:
    """Let Python look for reference cycles less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(_YOUNG, 20, 50)


class Sweeper:
    """Searches the young containers from time to time."""

    def __init__(self) -> None:
        self._due = time.monotonic() + _EVERY

    def look(self) -> None:
        """Search them if it is time."""
        if time.monotonic() >= self._due:
            gc.collect(0)
            self._due = time.monotonic() + _EVERY
