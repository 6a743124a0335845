"""The parameters of a rule: its own constants, and the Detector's overrides for individual clients."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from wayside.api import Detector, EventRule
from wayside.api.documents import FieldPath
from wayside.expressions import CelType, normalise
from wayside.names import did_you_mean

Values = Mapping[str, Any]
"""Parameters by name, in the types of expressions."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """The values that expressions see as `parameters`."""

    own: Values = field(default_factory=dict)
    """The values of the rule."""
    overridden: Mapping[str, Values] = field(default_factory=dict)
    """All values for each client for which the Detector overrides some, by client."""

    def of(self, client: str) -> Values:
        """The values for one client."""
        return self.overridden.get(client, self.own)


NO_PARAMETERS = Parameters()


def parameters_of(rule: EventRule, detector: Detector) -> Parameters:
    """The rule's parameters in that Detector, without invalid overrides (see `override_problems`)."""
    own = _values(rule.spec.parameters)
    wrong = {path for path, _ in override_problems(rule, detector)}
    overridden = {
        client.name: {
            **own,
            **_values({name: value for name, value in values.items() if _path(index, rule.name, name) not in wrong}),
        }
        for index, client in enumerate(detector.spec.clients)
        if (values := client.parameters.get(rule.name))
    }
    return Parameters(own, overridden)


def kinds_of(rule: EventRule) -> Mapping[str, CelType]:
    """The types of the rule's parameters, by their paths in expressions, including those of a pair's a and b."""
    prefixes = ("", "a.", "b.") if rule.spec.scope.pairs is not None else ("",)
    return {
        f"{prefix}parameters.{name}": cel_type
        for prefix in prefixes
        for name, value in rule.spec.parameters.items()
        if (cel_type := _kind(value).cel_type) is not None
    }


def override_problems(rule: EventRule, detector: Detector) -> Iterator[tuple[FieldPath, str]]:
    """The problems of the Detector's overrides for the rule's parameters: the Detector's field, and the message."""
    own = rule.spec.parameters
    for index, client in enumerate(detector.spec.clients):
        for name, value in client.parameters.get(rule.name, {}).items():
            path = _path(index, rule.name, name)
            if name in own:
                yield from ((path, text) for text in _misfits(name, own[name], value, rule.name))
            else:
                hint = did_you_mean(name, own) or f"it has {', '.join(sorted(own)) or 'none'}"
                yield path, f"EventRule {rule.name} has no parameter {name}; {hint}"


def unknown_rules(detector: Detector, rules: Iterable[str]) -> Iterator[tuple[FieldPath, str]]:
    """The Detector's overrides for unknown rules: the field of the Detector, and the remedy."""
    names = list(rules)
    for index, client in enumerate(detector.spec.clients):
        for rule in client.parameters:
            if rule not in names:
                hint = did_you_mean(rule, names) or "give its file as well, or remove the parameters"
                yield ("spec", "clients", index, "parameters", rule), f"there is no EventRule {rule} here; {hint}"


def _misfits(name: str, own: object, other: object, rule: str) -> Iterator[str]:
    """The differences of type between an override and the rule's own value, also between their items."""
    wanted, given = _kind(own).name, _kind(other).name
    if wanted != given:
        yield f"{name} must be a {wanted}, as in EventRule {rule}; got a {given}, {other!r:.60}"
    elif isinstance(own, list) and isinstance(other, list) and own:
        for index, item in enumerate(other):
            yield from _misfits(f"{name}[{index}]", own[min(index, len(own) - 1)], item, rule)
    elif isinstance(own, dict) and isinstance(other, dict):
        for key in own.keys() & other.keys():
            yield from _misfits(f"{name}.{key}", own[key], other[key], rule)


class _Kind(NamedTuple):
    name: str
    cel_type: CelType | None = None


_NUMBER: Final = _Kind("number", CelType.DOUBLE)
_KINDS: Final = {
    bool: _Kind("boolean", CelType.BOOL),
    int: _NUMBER,
    float: _NUMBER,
    str: _Kind("string", CelType.STRING),
    list: _Kind("list", CelType.LIST),
    dict: _Kind("map", CelType.MAP),
}


def _kind(value: object) -> _Kind:
    return _KINDS.get(type(value)) or _Kind(type(value).__name__)


def _values(constants: Mapping[str, Any]) -> Values:
    return {name: normalise(value) for name, value in constants.items()}


def _path(client: int, rule: str, name: str) -> FieldPath:
    return ("spec", "clients", client, "parameters", rule, name)
