"""The one place where samples get their receive time.

Stamping and queueing happen under one lock for all streams: the queue is in the order of the receive times, and those
never repeat. The engine takes the same lock to move `last` up to its tick and to swap the queue, so nothing that is
queued later can belong before the tick. Stamping outside the lock, or a queue per stream, would reorder samples.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from detector.engine.sample import SAMPLE_OVERHEAD, Arrival

_new_arrival = tuple.__new__
"""Makes an Arrival from a plain tuple at a third of the cost of calling the class: it is made for every message."""


class Intake:
    """A bounded queue of arrivals. When it is full, what comes is dropped and counted."""

    __slots__ = ("_last", "_lock", "_maximum_bytes", "_now", "_queue", "_room", "dropped")

    def __init__(self, now: Callable[[], int], *, maximum_bytes: int = 512 * 2**20) -> None:
        """`now` gives nanoseconds since the epoch; `maximum_bytes` bounds what waits, overhead included."""
        self._now = now
        self._maximum_bytes = maximum_bytes
        self._lock = threading.Lock()
        self._queue: list[Arrival] = []
        self._room = maximum_bytes
        self._last = 0
        self.dropped = 0

    def putter(self, stream: str) -> Callable[[str, bytes], None]:
        """A function that takes a message of the stream: its key and payload. Thread-safe; never waits."""
        lock, now = self._lock, self._now

        def put(key: str, payload: bytes) -> None:
            # This runs for every message, on the thread that receives it: each line here costs the vehicle's data rate.
            with lock:
                time = now()
                if time <= self._last:
                    time = self._last + 1
                self._last = time
                if self._room <= 0:
                    self.dropped += 1
                    return
                self._room -= len(payload) + SAMPLE_OVERHEAD
                self._queue.append(_new_arrival(Arrival, (time, stream, key, payload)))

        return put

    def drain(self, until: int) -> list[Arrival]:
        """What was queued, in order. Everything that comes from now on is received after `until`."""
        with self._lock:
            self._last = max(self._last, until)
            queue, self._queue = self._queue, []
            self._room = self._maximum_bytes
        return queue

    @property
    def last(self) -> int:
        """The newest receive time given, or the last `until` if that is later."""
        return self._last

    def step_back(self, to: int) -> list[Arrival]:
        """The wall clock went back: empty the queue and go on from `to`."""
        with self._lock:
            queue, self._queue = self._queue, []
            self._room = self._maximum_bytes
            self._last = to
        return queue
