"""Signals that models compute: for all clients of a tick at once, from the rule's other signals and streams.

If an input of a client is unknown, the client is left out and its signal is unknown. If the model fails, the signals of
all clients in the batch are unknown, and an error is counted for each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from detector.engine.counters import RuleCounters
from detector.engine.samples.sample import DecodeError
from detector.engine.signals.signals import Signals
from wayside.api.model import ModelInput
from wayside.expressions import Reason, Unknown
from wayside.rules import CompiledModel, CompiledRule


def add_models(
    rule: CompiledRule, views: Mapping[str, dict[str, Any]], now: int, signals: Signals, counters: RuleCounters
) -> None:
    """Add the rule's model signals to the views, which are by client and contain the other known signals."""
    for model in rule.models:
        rows: dict[str, dict[str, Any]] = {}
        for client, view in views.items():
            row = _row(rule.name, model, client, view, now, signals, counters)
            if row is None:
                counters.unknowns += 1
            else:
                rows[client] = row
        if not rows or model.runner is None:
            continue
        try:
            values = model.runner.run([*rows.values()])
        except ValueError as error:
            for _ in rows:
                counters.note(Reason.ERROR, f"signal {model.name}: {error}")
            continue
        for client, value in zip(rows, values, strict=True):
            if isinstance(value, float) and np.isnan(value):
                counters.note(Reason.ABSENT, f"signal {model.name} is NaN")
            else:
                views[client][model.name] = value


def _row(
    rule: str,
    model: CompiledModel,
    client: str,
    view: Mapping[str, Any],
    now: int,
    signals: Signals,
    counters: RuleCounters,
) -> dict[str, Any] | None:
    """The client's inputs by name; None if one is unknown."""
    row: dict[str, Any] = {}
    for given in model.source.inputs:
        value = (
            _numbers(model, [view.get(name) for name in given.signals], given.signals, counters)
            if given.signals
            else _window(rule, model, given, client, now, signals, counters)
            if given.window is not None
            else _tensor(model, given, client, now, signals, counters)
        )
        if value is None:
            return None
        row[given.name] = value
    return row


def _numbers(
    model: CompiledModel, values: Sequence[Any], names: Sequence[str], counters: RuleCounters
) -> list[float] | None:
    """The values as doubles; None if one is unknown or not a number."""
    numbers = []
    for name, value in zip(names, values, strict=True):
        if value is None or isinstance(value, Unknown):
            return None
        if not isinstance(value, int | float):
            counters.note(Reason.ERROR, f"signal {model.name}: {name} must be a number; got {value!r:.80}")
            return None
        numbers.append(float(value))
    return numbers


def _window(
    rule: str,
    model: CompiledModel,
    given: ModelInput,
    client: str,
    now: int,
    signals: Signals,
    counters: RuleCounters,
) -> Any:
    """A row per step, a column per signal, oldest first."""
    window = given.window
    assert window is not None  # noqa: S101  the caller looked
    columns = []
    for name in window.signals:
        signal = model.windows[given.name, name]
        samples = signals.window(rule, signal, client, now, counters, at_most=window.last)
        times = [time - now for time, _ in reversed(samples)]
        values = _numbers(model, [value for _, value in reversed(samples)], [name] * len(samples), counters)
        if values is None or not values:
            return None
        if window.over is None:
            if len(values) < window.steps:
                return None
            columns.append(np.array(values))
        else:
            steps = np.linspace(-window.over.ns, 0, window.steps)
            if times[0] > -window.over.ns:
                return None
            columns.append(np.interp(steps, times, values))
    return columns[0] if len(columns) == 1 else np.stack(columns, axis=1)


def _tensor(
    model: CompiledModel, given: ModelInput, client: str, now: int, signals: Signals, counters: RuleCounters
) -> Any:
    source = given.image or given.points
    assert source is not None  # noqa: S101  an input has one of four
    assert model.runner is not None  # noqa: S101  the engine gets no rule whose models are not bound
    payload = signals.newest_payload(source.stream, client, now)
    if payload is None:
        return None
    try:
        return model.runner.tensor(given.name, payload)
    except DecodeError as error:
        counters.note(Reason.ERROR, f"signal {model.name}: {client}: {error}")
        return None
