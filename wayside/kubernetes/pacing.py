"""The pace of requests: a maximum in flight, few writes per namespace, and none while the API server requests a pause.

Namespaces take turns, and each has only as many writes in flight as the API server processes without queueing them. So
a flood of writes in one namespace takes neither places in this queue nor capacity of the API server from the others.
docs/decisions/0029 has the measurements.

The timeout of a request starts only after it has waited here. The number of workers bounds the number of waiting
requests: each worker sends the requests of one instance.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Generic, TypeVar

AT_ONCE = 24
"""The maximum number of requests in flight, for all queues together; watches do not count."""

LONGEST_HOLD = 60.0
"""The maximum pause after a Retry-After, in seconds."""

MOST_WRITES = 8
"""The maximum number of writes of one namespace in flight, if the API server is fast."""

Item = TypeVar("Item")

_SAMPLE = 16  # writes whose mean duration decides about the next step
_SPARSE, _DENSE = 0.3, 1.0  # writes of a namespace that wait at the API server: alpha and beta of TCP Vegas
_MEMORY = 300.0  # s; the shortest duration is that of this period and the previous one


class FairQueue(Generic[Item]):
    """A queue that is fair to namespaces: they take turns, and a flood of items in one delays no other."""

    def __init__(self) -> None:
        self._waiting: OrderedDict[str, deque[Item]] = OrderedDict()  # the first has the next turn

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def __contains__(self, namespace: str) -> bool:
        return namespace in self._waiting

    def count(self, namespace: str) -> int:
        """The number of waiting items of the namespace."""
        return len(self._waiting.get(namespace, ()))

    def add(self, namespace: str, item: Item) -> None:
        """Append an item to those of its namespace."""
        self._waiting.setdefault(namespace, deque()).append(item)

    def next(self, may: Callable[[str], bool] = lambda _: True) -> Item | None:
        """Take the next item of the namespaces that may have a turn; None if no item of these waits."""
        for namespace, items in self._waiting.items():
            if may(namespace):
                item = items.popleft()
                if items:
                    self._waiting.move_to_end(namespace)
                else:
                    del self._waiting[namespace]
                return item
        return None


class CongestionWindow:
    """The maximum number of writes of one namespace in flight, by the congestion control of TCP Vegas.

    The shortest mean duration of writes is the API server's processing time. Any longer duration is waiting time, from
    which Little's law gives the number of waiting writes of a namespace. An idle API server answers many requests as
    fast as one, so the window grows; a busy one takes longer for each, so the window shrinks.

    Attributes:
        room: the maximum number of writes.
    """

    def __init__(self) -> None:
        self.room = 1
        self._times: list[float] = []
        self._quickest = [float("inf"), float("inf")]  # s; in this period, and in the one before
        self._since = 0.0

    def note(self, took: float, now: float) -> None:
        """Note the duration of a write, in seconds; `now` is the time of any monotonic clock, in seconds."""
        self._times.append(took)
        if len(self._times) < _SAMPLE:
            return
        mean = sum(self._times) / len(self._times)
        self._times.clear()
        if now - self._since > _MEMORY:
            self._quickest = [mean, self._quickest[0]]
            self._since = now
        self._quickest[0] = min(self._quickest[0], mean)
        wait = self.room * (1 - min(self._quickest) / mean)
        if wait < _SPARSE:
            self.room = min(MOST_WRITES, self.room + 1)
        elif wait > _DENSE:
            self.room = max(1, self.room - 1)


class Pacing:
    """Decides when requests may start."""

    def __init__(self, at_once: int = AT_ONCE, share: CongestionWindow | None = None) -> None:
        """`share` limits the writes in one namespace; None: no limit."""
        self._at_once = at_once
        self._share = share
        self._in_flight = 0
        self._writing: Counter[str] = Counter()  # writes by namespace
        self._waiting: FairQueue[tuple[str, asyncio.Future[None]]] = FairQueue()
        self._held_until = 0.0  # on the monotonic clock

    @property
    def held(self) -> float:
        """The number of seconds for which no request starts."""
        return max(0.0, self._held_until - time.monotonic())

    def hold(self, seconds: float) -> None:
        """Start no request for this time, as requested by the API server. A pending longer hold stays in effect."""
        self._held_until = max(self._held_until, time.monotonic() + seconds)

    @asynccontextmanager
    async def turn(self, writes_in: str = "") -> AsyncIterator[None]:
        """Wait for a place, and for the end of a hold. The request runs within the block.

        `writes_in`: the namespace of a write; empty for a read, and for a write outside of namespaces.
        """
        await self._acquire(writes_in)
        try:
            while (left := self.held) > 0:  # noqa: ASYNC110  the hold may be extended meanwhile
                await asyncio.sleep(left)
            began = time.monotonic()
            yield
            if writes_in and self._share is not None:  # a refused write raises, and its duration is not typical
                now = time.monotonic()
                self._share.note(now - began, now)
        finally:
            self._release(writes_in)

    async def _acquire(self, namespace: str) -> None:
        place: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.add(namespace, (namespace, place))
        self._admit()
        try:
            await place
        except asyncio.CancelledError:
            if not place.cancelled():  # it already had a place
                self._release(namespace)
            raise

    def _release(self, namespace: str) -> None:
        self._in_flight -= 1
        self._writing[namespace] -= 1
        if not self._writing[namespace]:
            del self._writing[namespace]
        self._admit()

    def _admit(self) -> None:
        while self._in_flight < self._at_once and (found := self._waiting.next(self._may)) is not None:
            namespace, place = found
            if not place.done():  # else its request was cancelled
                self._in_flight += 1
                self._writing[namespace] += 1
                place.set_result(None)

    def _may(self, namespace: str) -> bool:
        return self._share is None or not namespace or self._writing[namespace] < self._share.room
