"""The values that go into an event: what a rule saw of its subject."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from detector.engine.scoping.scopes import Candidate
from wayside.rules import CompiledRule, FleetSubject, PairSubject

_PLAIN = frozenset({float, bool, str})

_MEMBERS = 100
"""Maximum number of members of the fleet in an event; `count` is the number of all."""


def snapshot(rule: CompiledRule, candidate: Candidate) -> dict[str, Any]:
    """Signals, positions, distance and closing speed, where known; of a fleet its first members and their number."""
    variables = candidate.variables
    values = _of_the_scope(rule, variables)
    for plugin in rule.plugins:
        if plugin.name in variables:
            values[plugin.name] = variables[plugin.name]
    return values


def _of_the_scope(rule: CompiledRule, variables: Mapping[str, Any]) -> dict[str, Any]:
    match rule.subject:
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
        case _:
            return _signals_of(rule, variables)


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
    """Replace bytes, which a CEL expression may yield, by null: neither an event nor a task can carry them."""
    if isinstance(value, bytes):
        return None
    if isinstance(value, list):
        return [_without_bytes(item) for item in value]
    if isinstance(value, dict):
        return {key: _without_bytes(child) for key, child in value.items()}
    return value
