"""Statistics of an open episode: the values of its signals over the episode, from its start to the last evaluation.

They are exact sums, extremes and counts. Their size and their values therefore depend neither on the length of an
episode nor on the number of evaluations that are taken together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from detector.engine.counters import RuleCounters
from detector.engine.episodes.plain import plain
from wayside.api.eventrule import Aggregate
from wayside.expressions import UNKNOWN, Unknown, Value
from wayside.rules import CompiledDerived, CompiledRule

_SECOND = 10**9
_LEAST = frozenset({Aggregate.MIN, Aggregate.MIN_TIME})
_EXTREMES = _LEAST | {Aggregate.MAX, Aggregate.MAX_TIME}
_TRUTHS = frozenset({Aggregate.ALL, Aggregate.ANY})
_OF_ONE = frozenset({Aggregate.FIRST, Aggregate.LAST})


@dataclass(slots=True)
class Statistic:
    """One statistic. Fields that its aggregate does not use keep their defaults."""

    count: int = 0
    """Number of evaluations for Count, of numbers or booleans for the others."""
    value: Value | Unknown = UNKNOWN
    """The extreme; or the first or the last value; or whether all or any are true."""
    time: int = 0
    """The time of the extreme; nanoseconds."""
    total: Fraction = Fraction()
    """The sum of the finite numbers."""
    infinite: float = 0.0
    """The sum of the infinite numbers."""

    def add(self, aggregate: Aggregate, time: int, value: Value | Unknown) -> bool:
        """Add a value; False if the aggregate cannot use it."""
        if aggregate is Aggregate.COUNT:
            self.count += 1
        elif aggregate in _OF_ONE:
            if aggregate is Aggregate.LAST or not self.count:
                self.value = UNKNOWN if isinstance(value, bytes) else value
            self.count = 1
        elif isinstance(value, Unknown):
            return True
        elif aggregate in _TRUTHS:
            if not isinstance(value, bool):
                return False
            before = self.value if self.count else aggregate is Aggregate.ALL
            self.value = (before and value) if aggregate is Aggregate.ALL else (before or value)
            self.count += 1
        elif isinstance(value, bool) or not isinstance(value, int | float):
            return False
        else:
            self._add_number(aggregate, time, value)
        return True

    def _add_number(self, aggregate: Aggregate, time: int, number: float) -> None:
        if aggregate in _EXTREMES:
            known = self.value
            if not isinstance(known, int | float) or (number < known if aggregate in _LEAST else number > known):
                self.value, self.time = number or 0.0, time
        elif math.isinf(number):
            self.infinite += number
        else:
            self.total += Fraction(number)
        self.count += 1

    def result(self, aggregate: Aggregate) -> Value | Unknown:
        """The current result."""
        match aggregate:
            case Aggregate.COUNT:
                return float(self.count)
            case Aggregate.ANY:
                return self.value is True
            case Aggregate.MIN_TIME | Aggregate.MAX_TIME if self.count:
                return self.time / _SECOND
            case Aggregate.SUM | Aggregate.MEAN if self.count:
                return self._sum(1 if aggregate is Aggregate.SUM else self.count)
        return self.value

    def _sum(self, divisor: int) -> float | Unknown:
        if self.infinite:
            return UNKNOWN if math.isnan(self.infinite) else self.infinite
        try:
            return float(self.total / divisor)
        except OverflowError:
            return math.copysign(math.inf, self.total)

    def to_document(self) -> dict[str, Any]:
        """The statistic as a JSON document."""
        value, infinite = self.value, str(self.infinite)
        if isinstance(value, Unknown):
            kept: dict[str, Any] = {}
        else:
            infinite_value = isinstance(value, float) and not math.isfinite(value)
            kept = {"number": str(value)} if infinite_value else plain({"value": value})
        return {"count": self.count, **kept, "time": self.time, "total": str(self.total), "infinite": infinite}


class Statistics:
    """The statistics of one open episode."""

    def __init__(self, signals: Sequence[CompiledDerived], start: int) -> None:
        """`start` is the start of the episode, in nanoseconds."""
        self._signals = signals
        self._start = start
        self.until = start - 1
        """The last evaluation that was added; nanoseconds."""
        self._of = {signal.name: Statistic() for signal in signals if signal.of is not None}

    @classmethod
    def of(cls, rule: CompiledRule, start: int) -> Statistics | None:
        """The statistics of an episode of the rule; None if it has no signals over episodes."""
        signals = [signal for signal in rule.derived if signal.episode]
        return cls(signals, start) if signals else None

    def up_to(self, now: int, values: Mapping[str, Value], counters: RuleCounters) -> dict[str, Value]:
        """The known statistics after an evaluation with these values, which may have been added already."""
        if self.until < now:
            self.add(now, values, counters)
        return self.values(now)

    def add(self, time: int, values: Mapping[str, Value], counters: RuleCounters) -> None:
        """Add the values of an evaluation; unknown ones are left out. Counts values that cannot be used."""
        self.until = time
        for signal in self._signals:
            if signal.of is not None:
                value = values.get(signal.name, UNKNOWN)
                if not self._of[signal.name].add(signal.aggregate, time, value):
                    counters.errors += 1
                    message = f"{signal.aggregate} cannot use the value {value!r:.80}"
                    counters.last_error = f"signal {signal.name}: {message}"

    def values(self, now: int) -> dict[str, Value]:
        """The known statistics."""
        return dict(self._values(now))

    def _values(self, now: int) -> Iterator[tuple[str, Value]]:
        for signal in self._signals:
            if signal.of is None:
                yield signal.name, (now - self._start) / _SECOND
            elif not isinstance(value := self._of[signal.name].result(signal.aggregate), Unknown):
                yield signal.name, value

    def to_document(self) -> dict[str, Any]:
        """The statistics as a JSON document that survives a restart."""
        return {"until": self.until, "signals": {name: each.to_document() for name, each in self._of.items()}}

    def restore(self, document: Mapping[str, Any]) -> None:
        """Continue from a document that `to_document` made; missing or malformed statistics restart."""
        try:
            until = int(document["until"])
            restored = {name: _statistic(each) for name, each in document["signals"].items()}
        except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError):
            return
        self.until = until
        self._of |= {name: each for name, each in restored.items() if name in self._of}


def _statistic(document: Mapping[str, Any]) -> Statistic:
    value = float(document["number"]) if "number" in document else document.get("value", UNKNOWN)
    total, infinite = Fraction(document["total"]), float(document["infinite"])
    return Statistic(int(document["count"]), value, int(document["time"]), total, infinite)
