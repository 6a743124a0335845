"""Signals: a value computed from a client's samples of one stream, or unknown."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from detector.engine.buffer import Buffer, Lane
from detector.engine.clients import Clients, is_fresh
from detector.engine.counters import Counters, RuleCounters
from detector.engine.sample import DecodeError, Decoder, Sample
from wayside.api.eventrule import Aggregate
from wayside.expressions import UNKNOWN, Expression, Unknown, Value
from wayside.rules import CompiledPosition, CompiledSignal

Position = tuple[float, float, float]
"""Metres."""

_MISSING = object()


class Messages:
    """Decodes payloads when an expression asks for them, each at most once a tick."""

    def __init__(self, decoders: Mapping[str, Decoder], counters: Counters) -> None:
        self._decoders = decoders
        self._counters = counters
        self._decoded: dict[tuple[str, int], Any] = {}

    def forget(self) -> None:
        """Drop what was decoded: the tick is over."""
        self._decoded.clear()

    def message(self, stream: str, sample: Sample) -> Any:
        """The decoded sample, or UNKNOWN where it cannot be read; that is counted."""
        at = (stream, sample.number)
        message = self._decoded.get(at, _MISSING)
        if message is _MISSING:
            try:
                message = self._decoders[stream].decode(sample.payload)
            except DecodeError as error:
                self._counters.undecodable[stream] += 1
                self._counters.last_undecodable[stream] = str(error)
                message = UNKNOWN
            self._decoded[at] = message
        return message

    def stamp(self, stream: str, sample: Sample) -> int | None:
        """The sender's time, in nanoseconds, where the message carries one that can be read."""
        try:
            return self._decoders[stream].stamp(sample.payload)
        except DecodeError:
            return None

    def values(self, lane: Lane, sample: Sample, names: frozenset[str]) -> dict[str, Any] | None:
        """What an expression over one sample sees; None where the sample cannot be read."""
        values: dict[str, Any] = {}
        if "msg" in names:
            message = self.message(lane.stream, sample)
            if message is UNKNOWN:
                return None
            values["msg"] = message
        if "key" in names:
            values["key"] = lane.captures
        if "sample" in names:
            stamp = self.stamp(lane.stream, sample)
            values["sample"] = {
                "received": sample.received / 1e9,
                "size": float(len(sample.payload)),
                **({} if stamp is None else {"stamp": stamp / 1e9, "latency": (sample.received - stamp) / 1e9}),
            }
        return values


class Signals:
    """Computes the signals and positions of clients at a tick; values of samples are kept while they are looked at."""

    def __init__(
        self, buffer: Buffer, clients: Clients, messages: Messages, stale_after: Mapping[str, int | None]
    ) -> None:
        self._buffer = buffer
        self._clients = clients
        self._messages = messages
        self._stale_after = stale_after
        self._extracted: dict[tuple[str, str, str], dict[int, Value | Unknown | None]] = {}
        self._floor: int | None = None

    def gap(self, time: int) -> None:
        """Windows begin anew: what lies before `time` no longer counts in them."""
        self._floor = time
        self._extracted.clear()

    def forget(self, keep: Callable[[str, str], bool]) -> None:
        """Drop what is kept for rules and clients that are gone; `keep` says of (rule, client) whether it is needed."""
        gone = [key for key in self._extracted if not keep(key[0], key[2])]
        for key in gone:
            del self._extracted[key]

    def value(
        self, rule: str, signal: CompiledSignal, client: str, now: int, counters: RuleCounters
    ) -> Value | Unknown:
        """The signal's value at the tick `now`."""
        lane = self._buffer.lane(client, signal.stream)
        if signal.aggregate is Aggregate.AGE:
            return self._age(lane, client, now)
        if signal.aggregate is Aggregate.COUNT:
            return float(len(self._window(rule, signal, lane, client, now, counters))) if lane is not None else 0.0
        if lane is None or not is_fresh(client, signal.stream, self._stale_after[signal.stream], self._buffer, now):
            counters.unknowns += 1
            return UNKNOWN
        if signal.aggregate is Aggregate.LAST:
            newest = next(iter(self._window(rule, signal, lane, client, now, counters, newest_only=True)), UNKNOWN)
            return newest
        numbers = []
        for value in self._window(rule, signal, lane, client, now, counters):
            if isinstance(value, bool) or not isinstance(value, int | float):
                if value is not UNKNOWN:
                    counters.errors += 1
                    counters.last_error = f"signal {signal.name}: {signal.aggregate} needs numbers, is {value!r}"
                continue
            numbers.append(float(value))
        return _aggregated(signal.aggregate, numbers)

    def position(
        self, rule: str, position: CompiledPosition, client: str, now: int, counters: RuleCounters
    ) -> Position | None:
        """Where the client is, in metres, by the newest sample; None where that is not known or not finite."""
        lane = self._buffer.lane(client, position.stream)
        sample = None if lane is None else lane.newest
        if lane is None or sample is None or not self._is_fresh(client, position.stream, now):
            counters.unknowns += 1
            return None
        axes = []
        for expression in (position.x, position.y, position.z):
            value = 0.0 if expression is None else self._evaluate(expression, lane, sample, counters)
            if not isinstance(value, int | float):
                return None
            if not math.isfinite(value):
                counters.unknowns += 1
                return None
            axes.append(float(value))
        return axes[0], axes[1], axes[2]

    def _is_fresh(self, client: str, stream: str, now: int) -> bool:
        return is_fresh(client, stream, self._stale_after[stream], self._buffer, now)

    def _age(self, lane: Lane | None, client: str, now: int) -> float:
        newest = None if lane is None else lane.newest
        return (now - (self._clients.since(client) if newest is None else newest.time)) / 1e9

    def _window(
        self,
        rule: str,
        signal: CompiledSignal,
        lane: Lane,
        client: str,
        now: int,
        counters: RuleCounters,
        *,
        newest_only: bool = False,
    ) -> list[Value | Unknown]:
        """The values of the samples in the window, newest first; those that `where` leaves out are not among them."""
        key = (rule, signal.name, client)
        known = self._extracted.get(key, {})
        looked_at: dict[int, Value | Unknown | None] = {}
        values: list[Value | Unknown] = []
        for sample in self._in_window(signal, lane, now):
            number = sample.number
            value = known[number] if number in known else self._extract(signal, lane, sample, counters)
            looked_at[number] = value
            if value is not None:
                values.append(value)
                if newest_only:
                    break
        self._extracted[key] = looked_at
        return values

    def _in_window(self, signal: CompiledSignal, lane: Lane, now: int) -> Iterator[Sample]:
        after = None if signal.over_ns is None else now - signal.over_ns
        if after is not None and self._floor is not None:
            after = max(after, self._floor)
        return lane.newest_first(after, now)

    def _extract(
        self, signal: CompiledSignal, lane: Lane, sample: Sample, counters: RuleCounters
    ) -> Value | Unknown | None:
        """The sample's value; None where `where` is not true for it."""
        if signal.where is not None and self._evaluate(signal.where, lane, sample, counters) is not True:
            return None
        return True if signal.value is None else self._evaluate(signal.value, lane, sample, counters)

    def _evaluate(self, expression: Expression, lane: Lane, sample: Sample, counters: RuleCounters) -> Value | Unknown:
        values = self._messages.values(lane, sample, expression.names)
        if values is None:
            counters.unknowns += 1
            return UNKNOWN
        return expression.evaluate_or_unknown(values, counters.note)


def _aggregated(aggregate: Aggregate, numbers: list[float]) -> float | Unknown:
    if not numbers:
        return UNKNOWN
    match aggregate:
        case Aggregate.MIN:
            result = min(numbers)
        case Aggregate.MAX:
            result = max(numbers)
        case _:
            result = math.fsum(numbers) / len(numbers) if all(map(math.isfinite, numbers)) else sum(numbers)
    return UNKNOWN if math.isnan(result) else result
