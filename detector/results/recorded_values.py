"""Records the values of rules that are not in columns: each evaluation separately."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from detector.engine.scoping.scopes import Evaluated
from detector.engine.scoping.snapshots import snapshot
from detector.results.reasons import of_variables
from detector.results.series import AWAY, FALSE, TRUE, UNKNOWN, Series, SeriesKind, Steps, SubjectTrace
from wayside.expressions import UNKNOWN as NOT_KNOWN
from wayside.rules import CompiledRule

Plain = float | bool | str | None


@dataclass(slots=True)
class _Values:
    times: list[int] = field(default_factory=list)
    values: list[Plain] = field(default_factory=list)

    def add(self, time: int, value: Plain) -> bool:
        """Add a value; returns whether it differs from the previous one."""
        if self.values and type(self.values[-1]) is type(value) and self.values[-1] == value:
            return False
        self.times.append(time)
        self.values.append(value)
        return True

    def series(self) -> Series:
        times = np.array(self.times, np.int64)
        texts = tuple(dict.fromkeys(value for value in self.values if isinstance(value, str)))
        if texts:
            codes = {text: float(code) for code, text in enumerate(texts)}
            numbers = [codes.get(value, np.nan) if isinstance(value, str) else np.nan for value in self.values]
            return Series(times, np.array(numbers), SeriesKind.TEXT, texts)
        kind = SeriesKind.BOOLEAN if any(isinstance(value, bool) for value in self.values) else SeriesKind.NUMBER
        found = [np.nan if value is None else float(value) for value in self.values]
        return Series(times, np.array(found), kind)


@dataclass(slots=True)
class _Subject:
    clients: tuple[str, ...]
    values: dict[str, _Values] = field(default_factory=dict)
    conditions: dict[str, _Values] = field(default_factory=dict)
    reasons: dict[str, dict[int, str]] = field(default_factory=dict)
    last: int = 0


class RecordedValues:
    """The recorded values of one rule."""

    def __init__(self, rule: CompiledRule) -> None:
        self._rule = rule
        self._subjects: dict[str, _Subject] = {}
        self._begin: int | None = None
        self._end = 0

    @property
    def span(self) -> tuple[int, int]:
        """The first and the last evaluation; there must be one."""
        return self._begin or 0, self._end

    def record(self, evaluated: Evaluated) -> None:
        """Record the changes."""
        candidate, now = evaluated.candidate, evaluated.now
        self._begin = now if self._begin is None else self._begin
        self._end = now
        subject = self._subjects.get(candidate.subject.text)
        if subject is None:
            subject = self._subjects[candidate.subject.text] = _Subject(candidate.subject.clients)
        subject.last = now
        seen = dict(_plain(snapshot(self._rule, candidate)))
        for name in seen.keys() | subject.values.keys():
            subject.values.setdefault(name, _Values()).add(now, seen.get(name))
        conditions = {"when": (self._rule.when, evaluated.when)}
        if self._rule.until is not None:
            conditions["until"] = (self._rule.until, evaluated.until)
        for name, (expression, value) in conditions.items():
            code = AWAY if candidate.in_scope is False else UNKNOWN if value is NOT_KNOWN else TRUE if value else FALSE
            if subject.conditions.setdefault(name, _Values()).add(now, float(code)) and code == UNKNOWN:
                why = of_variables(self._rule, expression, candidate.variables)
                subject.reasons.setdefault(name, {})[now] = why

    def subjects(self) -> Iterator[SubjectTrace]:
        """Each subject that was evaluated."""
        for text, subject in self._subjects.items():
            found = SubjectTrace(self._rule.name, text, subject.clients)
            found.signals = {name: values.series() for name, values in sorted(subject.values.items())}
            for name, values in subject.conditions.items():
                series, reasons = values.series(), subject.reasons.get(name, {})
                why = {at: reasons[time] for at, time in enumerate(values.times) if time in reasons}
                found.conditions[name] = Steps(series.times, series.values.astype(np.uint8), why)
            yield found


def _plain(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Plain]]:
    """Numbers, booleans and texts by their names in expressions; lists appear only in events."""
    for name, value in values.items():
        if name == "client" and above:
            continue
        if isinstance(value, bool | str):
            yield above + name, value
        elif isinstance(value, int | float):
            yield above + name, float(value)
        elif isinstance(value, Mapping):
            yield from _plain(value, f"{above}{name}.")
