"""The values in an event: those that a rule read for its subject."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from detector.engine.scoping.scopes import Candidate
from wayside.expressions import Expression
from wayside.rules import ClientSubject, CompiledRule, FleetSubject, PairSubject

_PLAIN = frozenset({float, bool, str})

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")

_MEMBERS = 100
"""Maximum number of members of the fleet in an event; `count` is the number of all."""


def snapshot(rule: CompiledRule, candidate: Candidate) -> dict[str, Any]:
    """Signals, positions, distance and closing speed, if known; of a fleet its first members and their number."""
    variables = candidate.variables
    values = _of_the_scope(rule, variables)
    for others in (rule.plugins, rule.derived):
        for each in others:
            if each.name in variables:
                values[each.name] = _without_bytes(variables[each.name])
    return values


def signals_read(rule: CompiledRule, expression: Expression | None) -> str:
    """The signals that an expression reads, with their streams, for error messages."""
    steps: set[object] = set()
    if expression is not None:
        steps.update(step for path in expression.paths for step in path)
        if isinstance(rule.subject, FleetSubject):  # it reads the clients' signals by other names
            steps.update(_NAME.findall(expression.source))
    found = [f"{each.name} of stream {each.stream}" for each in rule.signals if each.name in steps and not each.rule]
    return f" ({', '.join(found)})" if found else ""


def _of_the_scope(rule: CompiledRule, variables: Mapping[str, Any]) -> dict[str, Any]:
    match rule.subject:
        case ClientSubject():
            return _signals_of(rule, variables)
        case PairSubject():
            values: dict[str, Any] = {
                name: variables[name] for name in ("distance", "closingSpeed") if name in variables
            }
            for role in ("a", "b"):
                values[role] = _member(rule, variables[role])
            return values
        case FleetSubject():
            members = variables["members"]
            return {"count": float(len(members)), "members": [_member(rule, view) for view in members[:_MEMBERS]]}


def _member(rule: CompiledRule, view: Mapping[str, Any]) -> dict[str, Any]:
    values = {"client": view["client"], **_signals_of(rule, view)}
    if "position" in view:
        values["position"] = view["position"]
    return values


def _signals_of(rule: CompiledRule, view: Mapping[str, Any]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for signals in (rule.signals, rule.models):
        for signal in signals:
            name = signal.name
            if name in view:
                value = view[name]
                values[name] = value if type(value) in _PLAIN else _without_bytes(value)
    return values


def _without_bytes(value: Any) -> Any:
    """Replace bytes, which a CEL expression may return, by null: neither an event nor a task can contain them."""
    if isinstance(value, bytes):
        return None
    if isinstance(value, list):
        return [_without_bytes(item) for item in value]
    if isinstance(value, dict):
        return {key: _without_bytes(child) for key, child in value.items()}
    return value
