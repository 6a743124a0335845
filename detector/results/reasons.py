"""Why a condition is unknown, in a few words for users."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from detector.engine.buffering.buffer import NEVER
from detector.engine.columns.block import Block, Track
from wayside.expressions import Expression
from wayside.rules import CompiledRule, PairSubject

_OTHERWISE = "it reads a value that does not exist"


def why_unknown(block: Block, point: int, track: Track, expression: Expression | None) -> str:
    """Why the condition of a rule about clients is unknown at a point."""
    if expression is None:
        return _OTHERWISE
    values = block.values(track, point)
    for signal in track.rule.signals:
        if signal.name in expression.names and signal.name not in values:
            return f"{signal.name}: {of_stream(block, signal.stream, point)}"
    for each in track.rule.derived:
        if each.name in expression.names and each.name not in values:
            return f"{each.name}: no value"
    _, note = expression.explained(block.variables(track, point))
    return _OTHERWISE if note is None else note[1]


def of_stream(block: Block, stream: str, point: int) -> str:
    """Why a signal of a stream is unknown at a point."""
    latest = block.latest.get(stream)
    if latest is None or int(latest.flat[point]) == NEVER:
        return f"no sample of stream {stream} has arrived"
    if not block.fresh[stream].flat[point]:
        age = (int(block.times[point % len(block.ticks)]) - int(latest.flat[point])) / 1e9
        return f"stream {stream} is stale: its newest sample is {age:.1f} s old"
    return f"stream {stream} has no such value in its window"


def of_variables(rule: CompiledRule, expression: Expression | None, variables: Mapping[str, Any]) -> str:
    """Why a condition is unknown, from its variables; for rules that are not in columns."""
    if expression is None:
        return _OTHERWISE
    if isinstance(rule.subject, PairSubject):
        for role in ("a", "b"):
            if "position" not in variables[role]:
                return f"{role}.position: no sample of stream {rule.subject.position.stream}, or an old one"
    for name in (*(signal.name for signal in rule.signals), *(signal.name for signal in rule.derived)):
        if name in expression.names and name not in variables:
            return f"{name}: no value"
    _, note = expression.explained(variables)
    return _OTHERWISE if note is None else note[1]
