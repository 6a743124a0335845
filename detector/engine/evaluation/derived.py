"""Signals over other signals, for rules that are evaluated one by one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from detector.engine.columns.earlier import EarlierValues, Evaluations
from detector.engine.counters import RuleCounters
from detector.engine.scoping.scopes import Candidate, evaluated
from wayside.expressions import UNKNOWN
from wayside.expressions.columns.values import Texts, column_of, value_at
from wayside.rules import CompiledRule


def with_derived(
    rule: CompiledRule, earlier: EarlierValues, now: int, candidates: Iterable[Candidate], counters: RuleCounters
) -> Iterator[Candidate]:
    """The subjects with these signals among their variables, and with the values that statistics of episodes
    aggregate."""
    by_element: dict[str | None, list[Candidate]] = {}
    for candidate in candidates:
        by_element.setdefault(candidate.subject.element, []).append(candidate)
    for element in rule.elements:
        yield from _of_one(rule, earlier, now, element.name, by_element.get(element.name, []), counters)


def _of_one(
    rule: CompiledRule,
    earlier: EarlierValues,
    now: int,
    element: str | None,
    candidates: list[Candidate],
    counters: RuleCounters,
) -> Iterator[Candidate]:
    texts = Texts()
    variables: list[dict[str, Any]] = [dict(candidate.variables) for candidate in candidates]
    measured: list[dict[str, Any]] = [{} for _ in candidates]
    keys = np.array([earlier.key(candidate.subject) for candidate in candidates], np.int64)
    evaluations = Evaluations(keys, np.full(len(keys), now, np.int64), now)
    for signal in rule.derived:
        if signal.of is None:
            continue
        values = [
            evaluated(signal.of, seen, f"signal {signal.name} of {candidate.subject.text}", candidate.never, counters)
            for candidate, seen in zip(candidates, variables, strict=True)
        ]
        if not signal.episode:
            column = earlier.window(signal, element, evaluations, column_of(values, texts), texts, counters)
            values = [value_at(column, row, texts) for row in range(len(values))]
        for known, value in zip(measured if signal.episode else variables, values, strict=True):
            if value is not UNKNOWN:
                known[signal.name] = value
    for candidate, seen, over in zip(candidates, variables, measured, strict=True):
        yield candidate._replace(variables=seen, measured=over)
