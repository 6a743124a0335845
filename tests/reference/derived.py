"""Signals over signals: the values of expressions at the evaluations of one subject."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from tests.reference.aggregates import NOTHING, aggregated
from tests.reference.margins import margin
from tests.reference.scopes import SubjectView
from tests.reference.signals import evaluated, nanoseconds

Values = dict[str, Any]
"""The values of expressions by signal; NOTHING for unknown ones."""


@dataclass
class Evaluations:
    """All evaluations of one subject."""

    before: list[tuple[int, Values]] = field(default_factory=list)
    """Since windows were reset."""
    all: list[tuple[int, Values]] = field(default_factory=list)

    def look(self, signals: list[dict[str, Any]], look: SubjectView, now: int, kept: int) -> SubjectView:
        """The view with these signals, each of which reads those before it."""
        here: Values = {}
        self.before.append((now, here))
        self.all.append((now, here))
        variables, values = dict(look.variables), dict(look.values)
        for signal in signals:
            name = signal["name"]
            here[name] = evaluated(signal["of"], variables, look.names) if "of" in signal else NOTHING
            if "margin" in signal:
                here[name] = margin(signal["margin"], signal["scales"], variables, look.names)
            if signal.get("over") == "Episode":
                continue
            end = now - nanoseconds(signal.get("lag", "0s"))
            begin = end - (nanoseconds(signal["over"]) if "over" in signal else kept)
            window = [(time, seen[name]) for time, seen in self.before if begin < time <= end]
            value = aggregated(signal.get("aggregate", "Last"), window, signal.get("quantile"))
            if value is not NOTHING:
                variables[name] = values[name] = value
        return SubjectView(look.subject, variables, look.names, look.in_scope, look.near, values)

    def statistics(self, signals: list[dict[str, Any]], start: int, now: int) -> Values:
        """The statistics of the episode with that start."""
        found: Values = {}
        for signal in signals:
            if signal.get("over") == "Episode":
                name, aggregate = signal["name"], signal["aggregate"]
                window = [(time, seen[name]) for time, seen in self.all if start <= time <= now and name in seen]
                found[name] = (now - start) / 10**9 if aggregate == "Age" else aggregated(aggregate, window)
        return {name: value for name, value in found.items() if value is not NOTHING}
