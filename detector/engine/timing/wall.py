"""Clock Wall: a sample's time is its receive time, and the caller advances the time.

A tick sees the samples up to and including its time, and no later ones.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

from detector.engine.samples.sample import Arrival
from detector.engine.timing.schedule import Ticks
from detector.engine.timing.steps import Gap, Insert, Step, Tick


class WallTimeline:
    """Clock Wall: time is the receive time of samples."""

    def __init__(self, ticks: Ticks, start: int, *, exact: bool = True) -> None:
        """`exact`: see `steps.ORDER`; False is order 1."""
        self._ticks = ticks
        self._exact = exact
        self.now = start
        """All ticks up to this time have run."""

    def steps(self, arrivals: Sequence[Arrival], until: int) -> Iterator[Step]:
        """All steps up to `until`, or up to the last arrival if that is later.

        The arrivals are in time order. The arrivals of later calls are later than these arrivals and than `until`:
        each tick up to that time sees all of its samples.
        """
        first, count = 0, len(arrivals)
        if count:
            until = max(until, arrivals[-1].received)
        due = self._due(arrivals)
        while True:
            tick = self._ticks.after(self.now)
            if due:
                tick = min(tick, due[0].received)
            if tick > until:
                break
            sampled = []
            while due and due[0].received == tick:
                sampled.append(due.popleft())
            last = _first_after(arrivals, tick, first)
            if last > first:
                yield Insert(arrivals[first:last], None)
                first = last
            self.now = tick
            yield Tick(tick, sampled)
        if first < count:
            yield Insert(arrivals[first:], None)
        self.now = max(self.now, until)

    def _due(self, arrivals: Sequence[Arrival]) -> deque[Arrival]:
        """The arrivals that are evaluated at their own times; not those of a stall, because time never goes back."""
        triggers, past = self._ticks.triggers, self.now if self._exact else 0
        if not triggers:
            return deque()
        return deque(each for each in arrivals if each.stream in triggers and each.received > past)

    def gap(self, time: int) -> Iterator[Step]:
        """The clock was stopped or jumped: continue at `time` without the ticks between."""
        backwards, self.now = time < self.now, time
        yield Gap(time, backwards)

    def rest(self) -> Iterator[Step]:
        """No step: this time axis queues no samples."""
        yield from ()

    def finish(self) -> Iterator[Step]:
        """No step: all ticks up to `now` have run."""
        yield from ()


def _first_after(arrivals: Sequence[Arrival], time: int, low: int) -> int:
    """The index of the first arrival received after `time`, at least `low`."""
    high = len(arrivals)
    while low < high:
        middle = (low + high) // 2
        if arrivals[middle].received <= time:
            low = middle + 1
        else:
            high = middle
    return low
