"""Clock Wall: a sample's time is its receive time, and the shell says how far time has come.

What a tick sees are the samples up to its time and none later.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from operator import itemgetter

from detector.engine.samples.sample import Arrival
from detector.engine.timing.steps import Gap, Insert, Step, Tick
from detector.engine.timing.ticks import Ticks

_RECEIVED = itemgetter(0)


class WallTimeline:
    """Clock Wall: time is when samples were received."""

    def __init__(self, ticks: Ticks, start: int) -> None:
        self._ticks = ticks
        self.now = start
        """Up to here all ticks have run."""

    def steps(self, arrivals: Sequence[Arrival], until: int) -> Iterator[Step]:
        """All that happens up to `until`, or up to the last arrival if that is later; they are in order.

        The intake stamps what it queues while it is being emptied later than `until`. Whatever comes after that is
        later still, so the ticks up to there can run, and a sample never enters before a tick that it comes after.
        What was received exactly at a tick counts at it.
        """
        first, count = 0, len(arrivals)
        if count:
            until = max(until, arrivals[-1].received)
        trigger = self._next_trigger(arrivals, 0)
        while True:
            tick = self._ticks.after(self.now)
            sampled = arrivals[trigger : trigger + 1] if trigger < count and arrivals[trigger].received <= tick else ()
            if sampled:
                tick = arrivals[trigger].received
                last = trigger + 1
                trigger = self._next_trigger(arrivals, last)
            elif tick <= until:
                last = _first_after(arrivals, tick, first)
            else:
                break
            if last > first:
                yield Insert(arrivals[first:last], None)
                first = last
            self.now = tick
            yield Tick(tick, sampled)
        if first < count:
            yield Insert(arrivals[first:], None)
        self.now = max(self.now, until)

    def _next_trigger(self, arrivals: Sequence[Arrival], first: int) -> int:
        """The index of the next arrival, from `first` on, that is evaluated at its own time; else their number."""
        triggers = self._ticks.triggers
        if not triggers:
            return len(arrivals)
        return next((at for at in range(first, len(arrivals)) if arrivals[at].stream in triggers), len(arrivals))

    def gap(self, time: int) -> Iterator[Step]:
        """The shell found that time stood still or jumped: go on from `time` without the ticks between."""
        backwards, self.now = time < self.now, time
        yield Gap(time, backwards)

    def rest(self) -> Iterator[Step]:
        """Nothing waits here."""
        yield from ()


def _first_after(arrivals: Sequence[Arrival], time: int, low: int) -> int:
    """The index of the first arrival received after `time`, at least `low`."""
    high = len(arrivals)
    while low < high:
        middle = (low + high) // 2
        if _RECEIVED(arrivals[middle]) <= time:
            low = middle + 1
        else:
            high = middle
    return low
