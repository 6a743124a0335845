"""The one place where samples get their receive time.

A message is stamped and queued by the thread that receives it, without a lock: taking one would cost more than all the
rest. What several threads do at the same moment may therefore be queued out of order by a few microseconds, and a
thread may be held up between stamping and queueing. So the times are settled when the queue is emptied: each is later
than the one before and later than the last `until`. Nothing that is drained later can belong before a tick that ran.
"""

from __future__ import annotations

import operator
import threading
from collections.abc import Callable, Sequence
from itertools import islice

from detector.engine.samples.sample import SAMPLE_OVERHEAD, Arrival

_PAUSE = 0.01
"""Seconds between two looks whether there is room."""

_RECEIVED = operator.itemgetter(0)


class Intake:
    """A bounded queue of arrivals. When it is full, what comes is dropped and counted."""

    __slots__ = ("_last", "_lock", "_maximum_bytes", "_now", "_queue", "_room", "dropped")

    def __init__(self, now: Callable[[], int], *, maximum_bytes: int = 512 * 2**20) -> None:
        """`now` gives nanoseconds since the epoch; `maximum_bytes` bounds what waits, overhead included.

        The bound is kept to within what the threads queue at one go.
        """
        self._now = now
        self._maximum_bytes = maximum_bytes
        self._lock = threading.Lock()
        self._queue: list[Arrival] = []
        """Stays the same list: appending to it and cutting off its beginning are each one step of the interpreter."""
        self._room = maximum_bytes
        self._last = 0
        self.dropped = 0

    def putter(self, stream: str) -> Callable[[Sequence[tuple[str, bytes]]], None]:
        """A function that takes messages of the stream that came together: the key and the payload of each.

        Thread-safe; never waits. What comes together has the time of being queued, in its order.
        """
        now, extend, new = self._now, self._queue.extend, tuple.__new__

        def put(messages: Sequence[tuple[str, bytes]]) -> None:
            # This runs for every message, on the thread that receives it: each step costs the vehicle's data rate.
            if self._room <= 0:
                self._drop(len(messages))
                return
            self._room -= sum([len(payload) for _, payload in messages]) + len(messages) * SAMPLE_OVERHEAD
            time = now()
            # Makes an Arrival from a plain tuple, at a third of the cost of calling the class.
            extend([new(Arrival, (t, stream, key, payload)) for t, (key, payload) in enumerate(messages, time)])

        return put

    def patient_putter(self, stream: str, patience: float = 1.0) -> Callable[[Sequence[tuple[str, bytes]]], None]:
        """The same for what is rare and should not be dropped: it waits for room, at most `patience` seconds."""
        put = self.putter(stream)
        pause = threading.Event()

        def patient(messages: Sequence[tuple[str, bytes]]) -> None:
            waited = 0.0
            while self._room <= 0 and waited < patience:
                pause.wait(_PAUSE)
                waited += _PAUSE
            put(messages)

        return patient

    def drain(self, until: int) -> list[Arrival]:
        """What was queued, in order. Everything that is drained later is received after `until`."""
        arrivals = self._queue[:]
        del self._queue[: len(arrivals)]
        self._room = self._maximum_bytes
        if arrivals:
            if not _in_order(arrivals, self._last):
                arrivals = _settled(arrivals, self._last)
            self._last = arrivals[-1].received
        self._last = max(self._last, until)
        return arrivals

    @property
    def last(self) -> int:
        """The newest receive time drained, or the last `until` if that is later."""
        return self._last

    def step_back(self, to: int) -> None:
        """The wall clock went back: what is drained from now on may be received as early as just after `to`."""
        self._last = to

    def _drop(self, count: int) -> None:
        with self._lock:
            self.dropped += count


def _in_order(arrivals: list[Arrival], last: int) -> bool:
    """Whether the times are later than `last` and strictly increasing, as they nearly always are."""
    times = list(map(_RECEIVED, arrivals))
    return times[0] > last and all(map(operator.lt, times, islice(times, 1, None)))


def _settled(arrivals: list[Arrival], last: int) -> list[Arrival]:
    """The same with times that are later than `last` and strictly increasing."""
    settled = []
    for arrival in arrivals:
        last = max(arrival.received, last + 1)
        settled.append(arrival._replace(received=last))
    return settled
