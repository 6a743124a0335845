"""Turns arrivals into what the engine does next: samples to insert, ticks to evaluate, gaps to say.

With clock Wall a sample's time is its receive time, and the shell says how far time has come. With clock Data it is the
sender's stamp, and the samples themselves say it: tick t is due once a stamp of at least t + lateness was seen.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter

from detector.engine.sample import Arrival

_RECEIVED = itemgetter(0)

HOUSEKEEPING = 1_000_000_000
"""There is a tick at least this often, in nanoseconds, also without rules: old samples are forgotten at ticks."""


@dataclass(frozen=True, slots=True)
class Insert:
    """Samples to insert, with their times."""

    arrivals: Sequence[Arrival]
    times: Sequence[int] | None
    """None: the receive times."""


@dataclass(frozen=True, slots=True)
class Tick:
    """Evaluate the rules that are due at this time."""

    time: int


@dataclass(frozen=True, slots=True)
class Gap:
    """Time went on (or back) to `time` without ticks."""

    time: int
    backwards: bool


Step = Insert | Tick | Gap


class Ticks:
    """The whole multiples of the rules' periods."""

    def __init__(self) -> None:
        self._periods: tuple[int, ...] = (HOUSEKEEPING,)

    def set_periods(self, periods: Collection[int]) -> None:
        """The rules' periods, in nanoseconds."""
        self._periods = tuple(sorted({HOUSEKEEPING, *periods}))

    def after(self, time: int) -> int:
        """The first tick after a time."""
        return min(time - time % period + period for period in self._periods)


class WallTimeline:
    """Clock Wall: time is when samples were received."""

    def __init__(self, ticks: Ticks, start: int) -> None:
        self._ticks = ticks
        self.now = start
        """Up to here all ticks have run."""

    def steps(self, arrivals: Sequence[Arrival], until: int) -> Iterator[Step]:
        """All that happens up to `until`; the arrivals are in order of their receive times, none after `until`.

        What was received exactly at a tick counts at it.
        """
        first, count = 0, len(arrivals)
        while (tick := self._ticks.after(self.now)) <= until:
            last = _first_after(arrivals, tick, first)
            if last > first:
                yield Insert(arrivals[first:last], None)
                first = last
            self.now = tick
            yield Tick(tick)
        if first < count:
            yield Insert(arrivals[first:], None)
        self.now = max(self.now, until)

    def gap(self, time: int) -> Iterator[Step]:
        """The shell found that time stood still or jumped: go on from `time` without the ticks between."""
        backwards, self.now = time < self.now, time
        yield Gap(time, backwards)


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


class DataTimeline:
    """Clock Data: time is the senders' stamps.

    A stamp more than `max_ahead` ahead of the rest, or so far behind that the buffer has no room for it, is dropped and
    counted. Time that really jumped (a pause in a recording, a simulation that began again) shows in what follows: when
    two samples in a row agree on another time, from two clients where there are two, that time holds from then on.
    """

    def __init__(
        self,
        ticks: Ticks,
        *,
        lateness: int,
        max_ahead: int,
        max_behind: int,
        stamp_of: Callable[[Arrival], int | None],
        client_of: Callable[[Arrival], str | None],
    ) -> None:
        """Times are in nanoseconds.

        `stamp_of` and `client_of` give None where they cannot tell; the sample is then left out, and they count it.
        """
        self._ticks = ticks
        self._lateness = lateness
        self._max_ahead = max_ahead
        self._max_behind = max_behind
        self._stamp_of = stamp_of
        self._client_of = client_of
        self._newest: int | None = None
        self._clients: set[str] = set()
        self._astray: dict[str, int] = {}
        """The stamps of the last samples in a row that do not fit the time, by client."""
        self._astray_count = 0
        self.now = 0
        self.dropped_ahead = 0
        self.dropped_late = 0

    def steps(self, arrivals: Sequence[Arrival], until: int) -> Iterator[Step]:
        """All that the arrivals make happen; `until`, a time of the wall, says nothing here."""
        for arrival in arrivals:
            client = self._client_of(arrival)
            stamp = None if client is None else self._stamp_of(arrival)
            if client is None or stamp is None:
                continue
            self._clients.add(client)
            if self._newest is None:
                self.now = stamp - 1
                self._newest = stamp
            elif self._fits(stamp, self._newest):
                self._astray.clear()
                self._astray_count = 0
                self._newest = max(self._newest, stamp)
            elif self._jumped(client, stamp):
                backwards, self._newest, self.now = stamp < self._newest, stamp, stamp - 1
                yield Gap(self.now, backwards)
            else:
                continue
            yield Insert((arrival,), (stamp,))
            while (tick := self._ticks.after(self.now)) <= self._newest - self._lateness:
                self.now = tick
                yield Tick(tick)

    def gap(self, time: int) -> Iterator[Step]:
        """Steps and stalls of the wall clock do not touch the time of the data."""
        yield from ()

    def _fits(self, stamp: int, newest: int) -> bool:
        return newest - self._max_behind <= stamp <= newest + self._max_ahead

    def _jumped(self, client: str, stamp: int) -> bool:
        """Whether this sample, which does not fit, shows that time jumped; else it is dropped."""
        if any(abs(stamp - other) > self._max_ahead for other in self._astray.values()):
            self._astray.clear()
            self._astray_count = 0
        self._astray[client] = stamp
        self._astray_count += 1
        if self._astray_count >= 2 and len(self._astray) >= min(2, len(self._clients)):
            self._astray.clear()
            self._astray_count = 0
            return True
        if self._newest is not None and stamp > self._newest:
            self.dropped_ahead += 1
        else:
            self.dropped_late += 1
        return False


Timeline = WallTimeline | DataTimeline
