"""Assigns the receive time of all samples.

The thread that receives a message stamps and queues it without a lock: a lock would cost more than both steps. Two
threads may therefore queue out of order by a few microseconds, and a thread may pause between stamping and queueing.
`drain` makes the times monotonic: they never go back, and all are later than those drained before and than the last
`until`. No sample has a time whose tick has already run. Samples of equal time are drained together, in their
order.
"""

from __future__ import annotations

import operator
import threading
from collections.abc import Callable, Sequence

from msgspec.structs import replace

from detector.engine.samples.sample import SAMPLE_OVERHEAD, Arrival

Put = Callable[[Sequence[tuple[str, bytes]]], None]
"""Receives messages that arrived together: the key and the payload of each. Thread-safe, and never waits."""

_PAUSE = 0.01
"""Seconds between two checks for room."""

_RECEIVED = operator.attrgetter("received")


class Intake:
    """A bounded queue of arrivals. When it is full, new messages are dropped and counted."""

    __slots__ = ("_last", "_lock", "_maximum_bytes", "_now", "_queue", "_room", "dropped", "on_urgent", "urgent")

    def __init__(self, now: Callable[[], int], *, maximum_bytes: int = 512 * 2**20) -> None:
        """`now` returns nanoseconds since the epoch; `maximum_bytes` bounds the queued messages, including overhead.

        It can be exceeded by the messages that the threads queue at the same moment.
        """
        self._now = now
        self._maximum_bytes = maximum_bytes
        self._lock = threading.Lock()
        self._queue: list[Arrival] = []
        """Always the same list: appending to it and deleting its beginning are atomic in the interpreter."""
        self._room = maximum_bytes
        self._last = 0
        self.dropped = 0
        self.urgent: frozenset[str] = frozenset()
        """Streams whose messages should be drained at once."""
        self.on_urgent: Callable[[], None] = lambda: None
        """Called after messages of an urgent stream were queued, by the thread that queued them."""

    def putter(self, *streams: str) -> Put:
        """A function that takes messages: the key and the payload of each. Thread-safe; never waits.

        Each message gets the time at which it is queued. With several streams, each of them gets the message, with the
        same time and in the order of `streams`.
        """
        now, extend = self._now, self._queue.extend

        def put(messages: Sequence[tuple[str, bytes]]) -> None:
            # This runs for every message, on the thread that receives it: each step costs the vehicle's data rate.
            if self._room <= 0:
                self._drop(len(messages) * len(streams))
                return
            size = sum([len(payload) for _, payload in messages]) + len(messages) * SAMPLE_OVERHEAD
            self._room -= size * len(streams)
            extend(
                [
                    Arrival(time, stream, key, payload)
                    for key, payload in messages
                    for time in (now(),)
                    for stream in streams
                ]
            )
            if not self.urgent.isdisjoint(streams):
                self.on_urgent()

        return put

    def blocking_putter(self, stream: str, timeout: float = 1.0) -> Put:
        """A putter for rare messages that should not be dropped: waits for room, at most `timeout` seconds."""
        put = self.putter(stream)
        pause = threading.Event()

        def put_when_room(messages: Sequence[tuple[str, bytes]]) -> None:
            waited = 0.0
            while self._room <= 0 and waited < timeout:
                pause.wait(_PAUSE)
                waited += _PAUSE
            put(messages)

        return put_when_room

    def drain(self, until: int) -> list[Arrival]:
        """The queued messages, in time order. Messages drained later have later times, also later than `until`."""
        arrivals = self._queue[:]
        del self._queue[: len(arrivals)]
        self._room = self._maximum_bytes
        if arrivals:
            if not _in_order(arrivals, self._last):
                arrivals = _monotonic(arrivals, self._last)
            self._last = arrivals[-1].received
        self._last = max(self._last, until)
        return arrivals

    @property
    def last(self) -> int:
        """The newest receive time drained, or the last `until` if that is later."""
        return self._last

    def step_back(self, to: int) -> None:
        """The wall clock went back: messages drained from now on may have a receive time just after `to`."""
        self._last = to

    def _drop(self, count: int) -> None:
        with self._lock:
            self.dropped += count


def _in_order(arrivals: list[Arrival], last: int) -> bool:
    """Whether the times are later than `last` and never go back, which is almost always true."""
    times = list(map(_RECEIVED, arrivals))
    return times[0] > last and times == sorted(times)  # sorting a sorted list is the fastest check


def _monotonic(arrivals: list[Arrival], last: int) -> list[Arrival]:
    """The same arrivals, with times that are later than `last` and never go back."""
    adjusted = []
    time = last + 1
    for arrival in arrivals:
        time = max(arrival.received, time)
        adjusted.append(replace(arrival, received=time))
    return adjusted
