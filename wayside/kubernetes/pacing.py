"""The pace of requests: a limited number at once, few writes in one namespace, none while the API server wants a pause.

Namespaces take turns, and one has as many writes under way as the API server answers without a queue: a flood in one
leaves the others both the places here and the API server's time. docs/decisions/0029 has the measurements.

A request that waits here has not begun, so its own time limit does not count yet. The workers of the queues bound the
number of waiting requests: each worker sends those of one instance.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Generic, TypeVar

AT_ONCE = 24
"""Requests that are under way at the same time, of all queues together; watches are apart."""

LONGEST_HOLD = 60.0
"""The maximum seconds of a Retry-After that are respected."""

MOST_WRITES = 8
"""Writes of one namespace that are under way at the same time, where the API server is quick."""

Item = TypeVar("Item")

_SAMPLE = 16  # writes, whose mean time decides the next step
_SPARSE, _DENSE = 0.3, 1.0  # of a namespace's writes, those that wait at the API server: TCP Vegas' alpha and beta
_MEMORY = 300.0  # s; the quickest time is that of this period and the one before


class FairQueue(Generic[Item]):
    """A queue that is fair by namespace: namespaces take turns, so a flood of items in one delays no other."""

    def __init__(self) -> None:
        self._waiting: OrderedDict[str, deque[Item]] = OrderedDict()  # the first has the next turn

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def __contains__(self, namespace: str) -> bool:
        return namespace in self._waiting

    def count(self, namespace: str) -> int:
        """How many items of the namespace wait."""
        return len(self._waiting.get(namespace, ()))

    def add(self, namespace: str, item: Item) -> None:
        """Put an item behind the others of its namespace."""
        self._waiting.setdefault(namespace, deque()).append(item)

    def next(self, may: Callable[[str], bool] = lambda _: True) -> Item | None:
        """Take the next item out of the namespaces that may have a turn; None where none waits in any of these."""
        taken = self.take(may)
        return None if taken is None else taken[1]

    def take(self, may: Callable[[str], bool]) -> tuple[str, Item] | None:
        """The same, with its namespace."""
        for namespace, items in self._waiting.items():
            if may(namespace):
                item = items.popleft()
                if items:
                    self._waiting.move_to_end(namespace)
                else:
                    del self._waiting[namespace]
                return namespace, item
        return None


class CongestionWindow:
    """The maximum number of writes of one namespace that are under way: the congestion control of TCP Vegas.

    The quickest mean time of writes is the API server's own time for them. The rest of their time now, they wait there,
    and by Little's law that gives how many of a namespace's writes wait. An idle API server answers many requests as
    quickly as one, so the share grows; a busy one takes longer for each, so the share shrinks.

    Attributes:
        room: the number of writes.
    """

    def __init__(self) -> None:
        self.room = 1
        self._times: list[float] = []
        self._quickest = [float("inf"), float("inf")]  # s; in this period, and in the one before
        self._since = 0.0

    def note(self, took: float, now: float) -> None:
        """A write took this time, in seconds; `now` is on any clock that goes forward."""
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
    """Lets requests begin."""

    def __init__(self, at_once: int = AT_ONCE, share: CongestionWindow | None = None) -> None:
        """`share`: of writes in one namespace; None: any number."""
        self._at_once = at_once
        self._share = share
        self._under_way = 0
        self._writing: Counter[str] = Counter()  # writes by namespace
        self._waiting: FairQueue[asyncio.Future[None]] = FairQueue()
        self._held_until = 0.0  # on the monotonic clock

    @property
    def held(self) -> float:
        """For how many seconds no request begins."""
        return max(0.0, self._held_until - time.monotonic())

    def hold(self, seconds: float) -> None:
        """Let no request begin for this time, as the API server requests; a shorter time shortens no longer one."""
        self._held_until = max(self._held_until, time.monotonic() + seconds)

    @asynccontextmanager
    async def turn(self, writes_in: str = "") -> AsyncIterator[None]:
        """Wait for a place, and for the end of a hold; the request runs within the block.

        `writes_in`: the namespace of a write; empty: it is none, or not in a namespace.
        """
        await self._place(writes_in)
        try:
            while (left := self.held) > 0:  # noqa: ASYNC110  it may be prolonged meanwhile
                await asyncio.sleep(left)
            began = time.monotonic()
            yield
            if writes_in and self._share is not None:  # a refused one, which raises, does not take the usual time
                now = time.monotonic()
                self._share.note(now - began, now)
        finally:
            self._leave(writes_in)

    async def _place(self, namespace: str) -> None:
        place: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.add(namespace, place)
        self._admit()
        try:
            await place
        except asyncio.CancelledError:
            if not place.cancelled():  # it had one by then
                self._leave(namespace)
            raise

    def _leave(self, namespace: str) -> None:
        self._under_way -= 1
        self._writing[namespace] -= 1
        if not self._writing[namespace]:
            del self._writing[namespace]
        self._admit()

    def _admit(self) -> None:
        while self._under_way < self._at_once and (found := self._waiting.take(self._may)) is not None:
            namespace, place = found
            if not place.done():  # else its request was cancelled
                self._under_way += 1
                self._writing[namespace] += 1
                place.set_result(None)

    def _may(self, namespace: str) -> bool:
        return self._share is None or not namespace or self._writing[namespace] < self._share.room
