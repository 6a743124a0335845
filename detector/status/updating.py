"""Updates the status of a running detector: written by the evaluation thread, at most once a second, read by any other.

A request therefore neither waits for the evaluation nor delays it, and only the thread that writes the engine's
counters reads them. The cost per sample is limited: latencies are measured once a second, on the newest message of at
most a few clients.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future
from importlib.metadata import version
from itertools import islice

from detector.assembly import RefusedRule
from detector.engine.buffering.buffer import NEVER, Lane
from detector.engine.engine import Engine
from detector.engine.evaluation.rule import RuleRun
from detector.engine.samples.sample import Arrival
from detector.engine.timing.schedule import Schedule
from detector.findings.losses import Losses
from detector.status.explaining import RuleWatch
from detector.status.model import (
    ClientStatus,
    Drops,
    Histogram,
    RuleExplanation,
    RuleState,
    RuleStatus,
    Status,
    StreamStatus,
)

BOUNDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Bounds of the latency histograms, in seconds."""

_EVERY = 1_000_000_000
"""Nanoseconds between two statuses, and between two measurements of a latency."""

_MEASURED = 16
"""Maximum number of clients whose newest sample is measured for the latency of each stream or rule."""

_RATES_OVER = 10
"""Number of statuses over which rates are averaged."""

_CLIENTS = 200


class _Latencies:
    """A histogram in progress."""

    def __init__(self) -> None:
        self._counts = [0] * (len(BOUNDS) + 1)
        self._sum = 0.0

    def add(self, seconds: float) -> None:
        self._counts[bisect_left(BOUNDS, seconds)] += 1
        self._sum += seconds

    def histogram(self) -> Histogram:
        return Histogram(BOUNDS, tuple(self._counts), self._sum)


class StatusUpdater:
    """The latest status, and the data for the next one. Everything except `latest` is for the evaluation thread."""

    def __init__(self, engine: Engine, losses: Losses, now: Callable[[], int]) -> None:
        """`now` returns nanoseconds since the epoch."""
        self._engine = engine
        self._losses = losses
        self._now = now
        self._started = now()
        self._beat = time.monotonic()
        self._taken = 0
        self._refusals: dict[str, RefusedRule] = {}
        self._last: dict[str, Arrival] = {}
        """With clock Data, the last arrival of each stream: the buffer has only stamps."""
        self._last_ticks: dict[str, int] = {}
        """The tick at which a rule's latency was last measured: samples up to there are counted."""
        self._ticks: dict[str, int] = {}
        """By rule, its number of ticks at the last measurement. Kept after its removal, like the engine's counters."""
        self._counts: deque[tuple[int, dict[str, int]]] = deque(maxlen=_RATES_OVER + 1)
        self._stream_latencies: dict[str, _Latencies] = {}
        self._rule_latencies: dict[str, _Latencies] = {}
        self._version = version("wayside")
        self._watching: list[RuleWatch] = []
        self.gaps = 0
        self.demands: Collection[str] = ()
        """The names of the currently demanded tasks."""
        self.latest: Status = self._new_status(self._started)

    @property
    def silence(self) -> float:
        """Seconds since the last cycle of the evaluation; for any thread."""
        return time.monotonic() - self._beat

    def arrived(self, arrivals: Sequence[Arrival]) -> None:
        """The engine takes these in now."""
        if not self._engine.on_wall_clock:
            self._last.update((arrival.stream, arrival) for arrival in arrivals)

    def refused(self, refusals: Iterable[RefusedRule]) -> None:
        """Set the rules that are currently rejected."""
        self._refusals = {refusal.rule.name: refusal for refusal in refusals}
        self._taken = 0

    def watch(self, rule: str, subject: str | None) -> Future[RuleExplanation]:
        """The values that the rule's next evaluation reads: for a subject, or for the first ones. Raises ValueError."""
        watching = RuleWatch(self._engine, rule, subject)
        self._watching.append(watching)
        return watching.future

    def cycle_finished(self) -> None:
        """The evaluation has finished a cycle."""
        self._beat = time.monotonic()
        self._watching = [watching for watching in self._watching if not watching.is_over()]
        now = self._now()
        if self._engine.on_wall_clock:
            seen: dict[tuple[frozenset[str], int, int], list[float]] = {}
            for run in self._engine.rules.values():
                self._measure_rule(run, now, seen)
        if not self._taken <= now < self._taken + _EVERY:
            self.latest = self._new_status(now)

    def _new_status(self, now: int) -> Status:
        self._taken = now
        engine = self._engine
        spec, buffer, counters = engine.detector.spec, engine.buffer, engine.counters
        lanes: dict[str, list[Lane]] = {stream.name: [] for stream in spec.streams}
        for lane in buffer:
            lanes[lane.stream].append(lane)
        for name, of_stream in lanes.items():
            self._measure_stream(name, of_stream)
        self._counts.append((now, {name: counters.samples[name] for name in lanes}))
        self._forget(lanes)
        metadata = engine.detector.metadata
        missing = engine.clients.missing(self._axis())
        return Status(
            detector=engine.identity.detector,
            holder=engine.identity.holder,
            namespace=engine.identity.namespace,
            version=self._version,
            generation=getattr(metadata, "generation", None) or 0,
            clock=spec.clock.value,
            started=self._started / 1e9,
            taken=now / 1e9,
            now=engine.now / 1e9,
            gaps=self.gaps,
            buffered_bytes=buffer.bytes,
            maximum_bytes=buffer.maximum_bytes,
            client_count=len(engine.clients),
            clients=[*self._clients()],
            missing=missing[:_CLIENTS],
            missing_count=len(missing),
            demands=sorted(self.demands)[:_CLIENTS],
            demand_count=len(self.demands),
            streams=[self._stream(name, of_stream) for name, of_stream in lanes.items()],
            rules=[*self._rules()],
            drops=[
                Drops(loss.cause, loss.what, loss.count, loss.stream, loss.rule, loss.last)
                for loss in self._losses.all()
            ],
        )

    def _stream(self, name: str, lanes: Sequence[Lane]) -> StreamStatus:
        (first, before), (last, counts) = self._counts[0], self._counts[-1]
        newest = max((lane.latest for lane in lanes), default=NEVER)
        latencies = self._stream_latencies.setdefault(name, _Latencies())
        return StreamStatus(
            name=name,
            samples=counts[name],
            rate=(counts[name] - before.get(name, 0)) * 1e9 / (last - first) if last > first else 0.0,
            clients=sum(bool(lane.samples) for lane in lanes),
            age=None if newest == NEVER else max(0.0, (self._axis() - newest) / 1e9),
            buffered_samples=sum(len(lane.samples) for lane in lanes),
            buffered_bytes=sum(lane.bytes for lane in lanes),
            latency=latencies.histogram(),
        )

    def _axis(self) -> int:
        """The reference time of ages: with clock Wall the current time, even if ticks are rare."""
        return self._now() if self._engine.on_wall_clock else self._engine.now

    def _clients(self) -> Iterator[ClientStatus]:
        now, clients = self._axis(), self._engine.clients
        for name in islice(clients, _CLIENTS):
            yield ClientStatus(name, max(0.0, (now - clients.last(name)) / 1e9))

    def _rules(self) -> Iterator[RuleStatus]:
        runs = self._engine.rules
        for name in sorted({*runs, *self._refusals}):
            run, refusal = runs.get(name), self._refusals.get(name)
            if refusal is not None:
                state, message = RuleState.REFUSED, str(refusal)
            else:
                state, message = _state(runs[name], self._engine.schedule)
            if run is None:
                yield RuleStatus(name, state, message)
                continue
            counters, latencies = run.counters, self._rule_latencies.get(name)
            yield RuleStatus(
                name,
                state,
                message,
                evaluations=counters.evaluations,
                ticks=counters.ticks,
                time=counters.time_ns / 1e9,
                unknowns=counters.unknowns,
                absences=dict(counters.absences),
                errors=counters.errors,
                last_error=counters.last_error,
                started=counters.started,
                ended=counters.ended,
                open=run.open_episodes,
                pending=run.pending,
                latency=None if latencies is None else latencies.histogram(),
            )

    def _measure_stream(self, name: str, lanes: Sequence[Lane]) -> None:
        """Measure the latencies from stamp to receipt of the samples since the last measurement."""
        latencies = self._stream_latencies.setdefault(name, _Latencies())
        if not self._engine.on_wall_clock:
            arrival = self._last.pop(name, None)
            samples: Iterable[Arrival] = () if arrival is None else (arrival,)
        else:
            since = self._counts[-1][0] if self._counts else NEVER
            newest = (lane.newest for lane in lanes if lane.latest > since)
            samples = islice((sample for sample in newest if isinstance(sample, Arrival)), _MEASURED)
        for sample in samples:
            latency = self._engine.latency(sample, name)
            if latency is not None:
                latencies.add(latency)

    def _measure_rule(self, run: RuleRun, now: int, seen: dict[tuple[frozenset[str], int, int], list[float]]) -> None:
        """If the rule has just been evaluated, measure how long ago the new samples that it read were received.

        Once a second, the newest samples of a few clients; no sample is counted twice. `seen` is shared by the rules of
        one cycle: those that read the same streams in the same period read the same samples.
        """
        name, tick, ticks = run.rule.name, run.counters.last_tick, run.counters.ticks
        evaluated = ticks != self._ticks.get(name, 0)
        self._ticks[name] = ticks
        since = self._last_ticks.get(name, NEVER)
        if not evaluated or since <= tick < since + _EVERY:
            return
        self._last_ticks[name] = tick
        if tick < since:  # the wall clock stepped back: older samples were counted
            return
        latencies = self._rule_latencies.setdefault(name, _Latencies())
        key = run.rule.streams, since, tick
        if key not in seen:
            seen[key] = [(now - received) / 1e9 for received in self._receipts(*key)]
        for latency in seen[key]:
            latencies.add(latency)

    def _receipts(self, streams: Collection[str], since: int, tick: int) -> Iterator[int]:
        """The receive times of the newest samples after `since` and up to the tick, of a few clients."""
        lanes = (lane for lane in self._engine.buffer if lane.latest > since and lane.stream in streams)
        newest = (next(lane.newest_first(since, tick), None) for lane in lanes)
        return islice((sample.received for sample in newest if sample is not None), _MEASURED)

    def _forget(self, streams: Iterable[str]) -> None:
        """Forget removed streams and rules."""
        for of_streams in (self._stream_latencies, self._last):
            for name in of_streams.keys() - {*streams}:
                of_streams.pop(name)
        for name in self._rule_latencies.keys() - self._engine.rules.keys():
            self._rule_latencies.pop(name)


def _state(run: RuleRun, schedule: Schedule) -> tuple[RuleState, str]:
    if not run.rule.enabled:
        return RuleState.DISABLED, "enabled is false"
    if run.rule.name in schedule.paused:
        return RuleState.PAUSED, "open episodes are kept until the rule is resumed"
    if not run.rule.on_demand and (thinned := schedule.thinning(run.rule)) > 1:
        return RuleState.DEGRADED, f"the machine is too slow: only one in {thinned} evaluations of the rule runs"
    return RuleState.ACCEPTED, "dryRun: publishing events, running no action" if run.rule.dry_run else ""
