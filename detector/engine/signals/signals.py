"""Signals: a value computed from a client's samples of one stream, or unknown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final, cast

from detector.engine.buffering.buffer import NEVER, Buffer, Lane
from detector.engine.buffering.clients import Clients, is_fresh
from detector.engine.buffering.messages import Messages
from detector.engine.buffering.naming import PossibleStreams
from detector.engine.counters import RuleCounters
from detector.engine.samples.sample import Sample
from detector.engine.signals.aggregates import Timed, calculated, distinct, is_number
from detector.engine.signals.starts import EpisodeStarts
from wayside.api.eventrule import Aggregate
from wayside.expressions import UNKNOWN, Expression, Reason, Unknown, Value
from wayside.rules import CompiledSignal


class Signals:
    """Computes the signals of clients at a tick; values of samples are cached while they are in use."""

    def __init__(
        self,
        buffer: Buffer,
        clients: Clients,
        messages: Messages,
        stale_after: Mapping[str, int | None],
        starts: EpisodeStarts,
        possible: PossibleStreams,
        floor: int | None = None,
    ) -> None:
        """`starts` has the samples of signals over rules; windows start after `floor` (ns).

        A signal that a client can never have (see `possible`) is unknown, and this is not counted.
        """
        self._buffer = buffer
        self._clients = clients
        self._messages = messages
        self._stale_after = stale_after
        self._starts = starts
        self.possible = possible
        self._extracted: dict[tuple[str, str, str], dict[Sample, Value | Unknown | None]] = {}
        self._picked: dict[tuple[str, str, str], int] = {}
        """The time of the last sample selected by the `where` of an Age."""
        self._floor = floor

    def gap(self, time: int) -> None:
        """Reset windows: samples before `time` no longer count."""
        self._floor = time
        self._extracted.clear()
        self._picked = {key: last for key, last in self._picked.items() if last <= time}

    def forget(self, keep: Callable[[str, str], bool]) -> None:
        """Drop the state of removed rules and lost clients; `keep` returns whether (rule, client) is needed."""
        for kept in (self._extracted, self._picked):
            for key in [key for key in kept if not keep(key[0], key[2])]:
                del kept[key]

    def value(
        self, rule: str, signal: CompiledSignal, client: str, now: int, counters: RuleCounters
    ) -> Value | Unknown:
        """The signal's value at the tick `now`."""
        if signal.client is not None:
            client = signal.client
            if not self._clients.knows(client, now):
                return self._no_value(counters)
        if signal.rule is None:
            lane = self._buffer.lane(client, signal.stream)
        elif not self._starts.is_evaluated(signal.stream):
            counters.note(Reason.ABSENT, f"signal {signal.name}: rule {signal.rule} is disabled, refused or gone")
            return UNKNOWN
        else:
            lane = self._starts.lane(client, signal.stream)
        if signal.aggregate is Aggregate.ACTIVE:
            return self._starts.is_open(client, signal.stream, now)
        if signal.aggregate is Aggregate.AGE:
            return self._age(rule, signal, lane, client, now, counters)
        always_known = signal.aggregate in _ALWAYS_KNOWN
        if lane is None or not (always_known or self._is_fresh(client, signal.stream, now)):
            if always_known:
                return _ALWAYS_KNOWN[signal.aggregate]
            return self._no_value(counters) if self.possible(signal.stream, client) else UNKNOWN
        if counters.ages is not None and signal.rule is None:
            counters.ages.used(lane, now)
        aggregate = signal.aggregate
        window = self._window(
            rule,
            signal,
            lane,
            client,
            now,
            counters,
            at_most=_ENOUGH.get(aggregate),
            oldest_first=aggregate is Aggregate.FIRST,
        )
        value = aggregated(signal, client, window, counters)
        return self._no_value(counters) if value is UNKNOWN else value

    def window(
        self, rule: str, signal: CompiledSignal, client: str, now: int, counters: RuleCounters, *, at_most: int | None
    ) -> list[tuple[int, Value | Unknown]]:
        """Times and values of the signal's samples, newest first; empty if the stream is stale."""
        client = signal.client or client
        lane = self._buffer.lane(client, signal.stream)
        if lane is None or not self._is_fresh(client, signal.stream, now):
            return []
        window = self._window(rule, signal, lane, client, now, counters, at_most=at_most)
        return [(sample.time, value) for sample, value in window]

    def newest_payload(self, stream: str, client: str, now: int) -> bytes | None:
        """The bytes of the newest sample; None if there is none, or if the stream is stale."""
        lane = self._buffer.lane(client, stream)
        if lane is None or not self._is_fresh(client, stream, now):
            return None
        sample = next(lane.newest_first(None, now), None)
        return None if sample is None else sample.payload

    def _is_fresh(self, client: str, stream: str, now: int) -> bool:
        # The starts of a rule's episodes belong to no stream of the Detector: they never become stale.
        return stream not in self._stale_after or is_fresh(client, stream, self._stale_after[stream], self._buffer, now)

    def _no_value(self, counters: RuleCounters) -> Unknown:
        counters.unknowns += 1
        return UNKNOWN

    def _age(
        self, rule: str, signal: CompiledSignal, lane: Lane | None, client: str, now: int, counters: RuleCounters
    ) -> float:
        """Seconds since the last sample (selected by `where`); before the first, since the client became known."""
        latest = NEVER if lane is None else lane.latest
        if lane is not None and latest > now:  # starts of episodes are already there for all ticks of a block
            latest = next((sample.time for sample in lane.newest_first(None, now)), NEVER)
        if lane is not None and signal.where is not None:
            key = (rule, signal.place, client)
            picked = self._window(rule, signal, lane, client, now, counters, at_most=1)
            # Kept longer than in the buffer: an expired sample was still the last one.
            latest = self._picked[key] = picked[0][0].time if picked else self._picked.get(key, NEVER)
        return (now - (self._clients.since(client) if latest == NEVER else latest)) / 1e9

    def _window(
        self,
        rule: str,
        signal: CompiledSignal,
        lane: Lane,
        client: str,
        now: int,
        counters: RuleCounters,
        *,
        at_most: int | None = None,
        oldest_first: bool = False,
    ) -> list[tuple[Sample, Value | Unknown]]:
        """The samples in the window that `where` selects, with their values, newest first.

        At most `at_most` of them, from the newest or from the oldest.
        """
        key = (rule, signal.place, client)
        known = self._extracted.get(key, {})
        extracted: dict[Sample, Value | Unknown | None] = {}
        values: list[tuple[Sample, Value | Unknown]] = []
        samples: Iterable[Sample] = self._in_window(signal, lane, now)
        if oldest_first:
            samples = reversed(list(samples))  # so that only the oldest is decoded, not all later ones
        for sample in samples:
            # Keyed by the sample: equal samples have equal values.
            value = known[sample] if sample in known else self._extract(signal, lane, sample, counters)
            extracted[sample] = value
            if value is not None:
                values.append((sample, value))
                if len(values) == at_most:
                    break
        self._extracted[key] = extracted
        return values

    def _in_window(self, signal: CompiledSignal, lane: Lane, now: int) -> Iterator[Sample]:
        after = None if signal.over_ns is None or signal.aggregate is Aggregate.AGE else now - signal.over_ns
        if after is not None and self._floor is not None:
            after = max(after, self._floor)
        return lane.newest_first(after, now)

    def _extract(
        self, signal: CompiledSignal, lane: Lane, sample: Sample, counters: RuleCounters
    ) -> Value | Unknown | None:
        """The sample's value; None if `where` is not true for it."""
        if signal.where is not None and self._evaluate(signal.where, signal, lane, sample, counters) is not True:
            return None
        return True if signal.value is None else self._evaluate(signal.value, signal, lane, sample, counters)

    def _evaluate(
        self, expression: Expression, signal: CompiledSignal, lane: Lane, sample: Sample, counters: RuleCounters
    ) -> Value | Unknown:
        source = self._messages if signal.rule is None else self._starts
        values = source.values(lane.stream, sample, expression.names, signal.parameters.of(lane.client))
        if values is None:
            counters.unknowns += 1
            return UNKNOWN
        if signal.element is not None:
            values.update(signal.element.variables)
        return expression.evaluate_or_unknown(
            values, lambda reason, message: counters.note(reason, message, _place(signal, lane.client))
        )


def _place(signal: CompiledSignal, client: str) -> str:
    """The place of an error, for its message."""
    source = f"stream {signal.stream}" if signal.rule is None else f"rule {signal.rule}"
    return f"signal {signal.name} of {client}, {source}"


_ENOUGH: Final = {Aggregate.LAST: 1, Aggregate.PREVIOUS: 2, Aggregate.FIRST: 1}
"""Maximum number of samples that an aggregate needs, if not all."""

_ALWAYS_KNOWN: Final[Mapping[Aggregate, Value]] = {Aggregate.COUNT: 0.0, Aggregate.ANY: False}
"""The aggregates that are known without samples, or for a stale stream, with their values for an empty window."""


def aggregated(
    signal: CompiledSignal, client: str, window: Sequence[tuple[Sample, Value | Unknown]], counters: RuleCounters
) -> Value | Unknown:
    """The aggregate of the window, which is given newest first."""
    aggregate = signal.aggregate
    match aggregate:
        case Aggregate.COUNT:
            return float(len(window))
        case Aggregate.LAST | Aggregate.FIRST:
            return window[0][1] if window else UNKNOWN
        case Aggregate.PREVIOUS:
            return window[1][1] if len(window) > 1 else UNKNOWN
    known = [(sample.time, value) for sample, value in reversed(window) if not isinstance(value, Unknown)]
    match aggregate:
        case Aggregate.DISTINCT:
            return distinct([value for _, value in known])
        case Aggregate.ALL | Aggregate.ANY:
            truths = [value for _, value in _fitting(signal, client, known, _is_boolean, "booleans", counters)]
            if aggregate is Aggregate.ANY:
                return any(truths)
            return all(truths) if truths else UNKNOWN
    numbers = _fitting(signal, client, known, is_number, "numbers", counters)
    return calculated(aggregate, cast("list[Timed]", numbers), signal.quantile)


def _fitting(
    signal: CompiledSignal,
    client: str,
    known: Sequence[tuple[int, Value]],
    fits: Callable[[object], bool],
    wanted: str,
    counters: RuleCounters,
) -> list[tuple[int, Value]]:
    """The values of the types that the aggregate takes; the others are left out, and counted as errors."""
    fitting = []
    for time, value in known:
        if fits(value):
            fitting.append((time, value))
        else:
            counters.errors += 1
            needs = f"{signal.aggregate} needs {wanted}; got {value!r:.80}"
            counters.last_error = f"{_place(signal, client)}: {needs}"
    return fitting


def _is_boolean(value: object) -> bool:
    return isinstance(value, bool)
