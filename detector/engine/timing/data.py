"""Clock Data: a sample's time is the sender's stamp, and the samples advance the time.

Tick t runs once a stamp was seen that is at least t + lateness, and later than t. Samples of equal stamps that arrive
in order are therefore all inserted before their tick, even with a lateness of zero. At the end, the ticks up to the
newest stamp run.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from detector.engine.samples.liveliness import LIVELINESS
from detector.engine.samples.sample import SAMPLE_OVERHEAD, Arrival
from detector.engine.timing.schedule import Ticks
from detector.engine.timing.steps import Gap, Insert, Step, Tick


@dataclass(slots=True)
class _JumpCandidate:
    """Consecutive samples whose stamps agree with each other, but not with the time axis."""

    client: str
    first: int
    last: int
    received: int
    several: bool = False
    """Whether the samples come from more than one client."""


class DataTimeline:
    """Clock Data: time is the senders' stamps.

    A sample waits until the next tick after it, and then enters in the order of the stamps: the order in which samples
    arrive does not matter as long as `lateness` covers it. A sample that arrives after its tick is inserted at once.

    A stamp is dropped and counted if it is more than `max_ahead` ahead of the time expected by now (receive times show
    how long nothing arrived), or so far behind that the buffer has no room for it. If time really jumped (a pause in a
    recording, a simulation that restarted), the following samples show it: when consecutive samples agree on another
    time, that time is adopted. Two are enough if they come from two clients or if there is only one client; one client
    among several must persist for `alone_after` without contradiction.

    A sample of a latched stream may be old: it never advances the time, and is placed at its stamp, or at the newest
    stamp if its own is later.
    """

    def __init__(
        self,
        ticks: Ticks,
        *,
        start: int,
        lateness: int,
        max_ahead: int,
        max_behind: int,
        alone_after: int,
        maximum_bytes: int,
        stamp_of: Callable[[Arrival], int | None],
        client_of: Callable[[Arrival], str | None],
        latched: frozenset[str] = frozenset(),
        exact: bool = True,
    ) -> None:
        """Times are in nanoseconds; `start` is the time until the first stamp is seen.

        `maximum_bytes` bounds the waiting payloads; samples that arrive when they are full are dropped and counted.
        `stamp_of` and `client_of` return None for samples that they cannot read; they count these, and the sample is
        left out. `latched` are the names of the latched streams. `exact`: see `steps.ORDER`; False is order 1.
        """
        self._ticks = ticks
        self._lateness = lateness
        self._behind = max(lateness, 1) if exact else lateness
        """How far ticks stay behind the newest stamp."""
        self._max_ahead = max_ahead
        self.alone_after = alone_after
        self.maximum_bytes = maximum_bytes
        self._stamp_of = stamp_of
        self._client_of = client_of
        self._newest: int | None = None
        self._newest_received = 0
        self._ticked = False
        self._waiting: list[tuple[int, int, Arrival]] = []
        """A heap by stamp and order of arrival."""
        self._waiting_bytes = 0
        self._triggers: frozenset[str] = frozenset()
        self._trigger_stamps: list[int] = []
        """A heap: the stamps of waiting samples that are evaluated at their own times."""
        self._number = 0
        self._some_client: str | None = None
        self._several_clients = False
        self._candidate: _JumpCandidate | None = None
        self._early: list[tuple[int, Arrival]] = []
        """Latched samples that arrived before the first stamp, with their stamps."""
        self.latched = latched
        self.max_behind = max_behind
        self.now = start
        self.dropped_ahead = 0
        self.dropped_late = 0
        self.dropped_full = 0
        self.last = ""
        """A text about the last sample dropped because of its time, with its distance from the time axis."""
        self.jumps = 0

    def steps(self, arrivals: Sequence[Arrival], until: int) -> Iterator[Step]:
        """All steps that result from the arrivals; `until`, a time of the wall clock, is not used here."""
        for arrival in arrivals:
            if arrival.stream == LIVELINESS:
                yield from self._token(arrival)
                continue
            client = self._client_of(arrival)
            stamp = None if client is None else self._stamp_of(arrival)
            if client is None or stamp is None:
                continue
            if arrival.stream in self.latched:
                yield from self._insert_latched(arrival, stamp)
                continue
            self._note_client(client)
            newest = self._newest
            if newest is None:
                newest = stamp
                yield self._begin(stamp, backwards=False)
            elif newest - self.max_behind <= stamp <= newest + self._allowed_lead(arrival, self._newest_received):
                self._candidate = None
                if not self._ticked and newest - self._lateness <= stamp <= self.now:
                    yield self._begin(stamp, backwards=False)  # the first sample to arrive was not the earliest
                newest = max(newest, stamp)
            elif self._jumped(arrival, client, stamp, newest):
                self.jumps += 1
                yield from self.rest()
                backwards, newest = stamp < newest, stamp
                yield self._begin(stamp, backwards)
            else:
                continue
            if newest != self._newest:
                self._newest, self._newest_received = newest, arrival.received
            if stamp <= self.now:
                yield Insert((arrival,), (stamp,))
            else:
                self._wait(arrival, stamp)
            yield from self._run_up_to(newest - self._behind)

    def finish(self) -> Iterator[Step]:
        """No more samples follow: the ticks up to the newest stamp, and all waiting samples."""
        if self._newest is not None:
            yield from self._run_up_to(self._newest)
            yield from self.rest()
            self.now = max(self.now, self._newest)

    def _run_up_to(self, limit: int) -> Iterator[Step]:
        """The ticks up to there, including those of samples."""
        while True:
            tick = self._ticks.after(self.now)
            trigger = self._next_trigger()
            if trigger is not None and trigger <= min(tick, limit):
                tick = trigger
            elif tick > limit:
                return
            self.now, self._ticked = tick, True
            sampled: list[Arrival] = []
            for insert in self._release(tick):
                yield insert
                pairs = zip(insert.arrivals, insert.times or (), strict=True)
                sampled += [each for each, time in pairs if time == tick and each.stream in self._ticks.triggers]
            yield Tick(tick, sampled)

    def _next_trigger(self) -> int | None:
        """The earliest stamp of a waiting sample that is evaluated at its own time."""
        if self._triggers is not self._ticks.triggers:  # the rules changed
            self._triggers = self._ticks.triggers
            self._trigger_stamps = [stamp for stamp, _, each in self._waiting if each.stream in self._triggers]
            heapq.heapify(self._trigger_stamps)
        while self._trigger_stamps and self._trigger_stamps[0] <= self.now:
            heapq.heappop(self._trigger_stamps)
        return self._trigger_stamps[0] if self._trigger_stamps else None

    def gap(self, time: int) -> Iterator[Step]:
        """Steps and stalls of the wall clock do not affect the time of the data."""
        yield from ()

    def rest(self) -> Iterator[Step]:
        """All waiting samples, at once: this axis has no more ticks."""
        yield from self._release(None)

    def _token(self, arrival: Arrival) -> Iterator[Step]:
        """A change of a token has no stamp: it follows all samples with the newest stamp until now."""
        newest = self.now if self._newest is None else self._newest
        if newest <= self.now or self._waiting_bytes >= self.maximum_bytes:
            yield Insert((arrival,), (self.now,))
        else:
            self._wait(arrival, newest)

    def _insert_latched(self, arrival: Arrival, stamp: int) -> Iterator[Step]:
        """Insert or queue a sample of a latched stream."""
        if self._newest is None:
            self._early.append((stamp, arrival))
        elif (place := min(stamp, self._newest)) <= self.now:
            yield Insert((arrival,), (place,))
        else:
            self._wait(arrival, place)

    def _begin(self, stamp: int, backwards: bool) -> Gap:
        """Time starts, or restarts, with this stamp."""
        early, self._early = self._early, []
        for latched_stamp, arrival in early:
            self._wait(arrival, min(latched_stamp, stamp))
        self.now, self._ticked = stamp - 1, False
        return Gap(self.now, backwards)

    def _wait(self, arrival: Arrival, stamp: int) -> None:
        if self._waiting_bytes >= self.maximum_bytes:
            self.dropped_full += 1
            return
        self._number += 1
        self._waiting_bytes += len(arrival.payload) + SAMPLE_OVERHEAD
        heapq.heappush(self._waiting, (stamp, self._number, arrival))
        if arrival.stream in self._triggers:
            heapq.heappush(self._trigger_stamps, stamp)

    def _release(self, until: int | None) -> Iterator[Insert]:
        """The waiting samples with a stamp up to `until` (None: all), in order."""
        arrivals, times = [], []
        while self._waiting and (until is None or self._waiting[0][0] <= until):
            stamp, _, arrival = heapq.heappop(self._waiting)
            self._waiting_bytes -= len(arrival.payload) + SAMPLE_OVERHEAD
            arrivals.append(arrival)
            times.append(stamp)
        if arrivals:
            yield Insert(arrivals, times)

    def _note_client(self, client: str) -> None:
        """Record whether samples come from several clients."""
        if self._some_client is None:
            self._some_client = client
        elif client != self._some_client:
            self._several_clients = True

    def _allowed_lead(self, arrival: Arrival, since: int) -> int:
        """By how much the arrival's stamp may exceed one that was received at `since`; nanoseconds."""
        return self._max_ahead + max(0, arrival.received - since)

    def _jumped(self, arrival: Arrival, client: str, stamp: int, newest: int) -> bool:
        """Whether this sample, whose stamp is out of range, proves a jump of time; otherwise counts it as dropped."""
        candidate = self._candidate
        if candidate is not None and (
            -self._max_ahead <= stamp - candidate.last <= self._allowed_lead(arrival, candidate.received)
        ):
            candidate.several = candidate.several or client != candidate.client
            candidate.last, candidate.received = stamp, arrival.received
            if candidate.several or not self._several_clients or abs(stamp - candidate.first) >= self.alone_after:
                self._candidate = None
                return True
        else:
            self._candidate = _JumpCandidate(client, stamp, stamp, arrival.received)
        way = "ahead of" if stamp > newest else "behind"
        self.last = f"{client} is {abs(stamp - newest) / 1e9:g} s {way} the rest on stream {arrival.stream}"
        if stamp > newest:
            self.dropped_ahead += 1
        else:
            self.dropped_late += 1
        return False
