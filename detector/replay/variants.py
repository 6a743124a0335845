"""Variants of rules: a rule with changed fields, played in the same pass as the rule as written."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import yaml
from pydantic import ValidationError

from wayside.api import Detector, EventRule
from wayside.api.validation_errors import messages
from wayside.inputerror import InputError
from wayside.names import did_you_mean

_MOST = 100
"""Maximum number of variants."""
_RANGE = re.compile(r"(-?[0-9.eE+-]+):(-?[0-9.eE+-]+):([0-9.eE+-]+)")


class VariantError(InputError, ValueError):
    """A change that cannot be applied; the text names the option, the field and the remedy."""


class Change(NamedTuple):
    """One field of one rule, and its value."""

    rule: str
    path: tuple[str, ...]
    """The path below spec; items of lists by their names or numbers."""
    value: Any

    @property
    def label(self) -> str:
        """The label for users."""
        text = self.value if isinstance(self.value, str) else json.dumps(self.value)
        return f"{'.'.join(self.path)}={text}"


class Variant(NamedTuple):
    """A rule with changed fields. It has no actions, and a distinct name."""

    of: str
    """The rule as written."""
    label: str
    rule: EventRule
    parameters: frozenset[str]
    """The parameters of the rule that the variant sets for all clients."""
    is_written: bool = False
    """It is another rule as written, with its own name and actions, that is only compared."""


def variants_of(rules: Sequence[EventRule], sets: Sequence[str], sweeps: Sequence[str]) -> list[Variant]:
    """The variants named by the options: for each rule one with all `sets`, and one for each value of each sweep.

    `RULE=OTHER` names another rule in place of a variant.

    Raises:
        VariantError: an option cannot be parsed, names no rule or no field of it, or makes an invalid rule.
    """
    known = {rule.name: rule for rule in rules}
    fixed: dict[str, list[Change]] = {}
    others = []
    for option in sets:
        rule, path, text = _parts("--set", option, known)
        if not path:
            others.append(Variant(rule, f"rule {text}", known[_known("--set", option, text, known)], frozenset(), True))
            continue
        fixed.setdefault(rule, []).append(Change(rule, path, _value(text)))
    chosen = [*fixed.items()]
    for option in sweeps:
        rule, path, text = _parts("--sweep", option, known)
        chosen += [(rule, [*fixed.get(rule, ()), Change(rule, path, value)]) for value in _values(option, text)]
    if len(chosen) > _MOST:
        raise VariantError(f"--sweep may give at most {_MOST} variants; got {len(chosen)}: use larger steps")
    taken = set(known)
    return [*others, *(_variant(known[rule], changes, taken) for rule, changes in chosen)]


def with_variants(detector: Detector, variants: Sequence[Variant]) -> Detector:
    """The Detector, with its clients' parameters applied to variants as well, except those that they change."""
    if not any(client.parameters for client in detector.spec.clients):
        return detector
    clients = []
    for client in detector.spec.clients:
        parameters = dict(client.parameters)
        for variant in variants:
            own = {
                name: value
                for name, value in client.parameters.get(variant.of, {}).items()
                if name not in variant.parameters
            }
            if own:
                parameters[variant.rule.name] = own
        clients.append(client.model_copy(update={"parameters": parameters}))
    return detector.model_copy(update={"spec": detector.spec.model_copy(update={"clients": clients})})


def _parts(option: str, text: str, rules: Mapping[str, EventRule]) -> tuple[str, tuple[str, ...], str]:
    before, equals, value = text.partition("=")
    rule, *path = before.strip().split(".")
    if not equals or (not path and option != "--set"):
        raise VariantError(f"{option} must be RULE.FIELD=VALUE, e.g. close.when='distance < 120'; got {text}")
    _known(option, text, rule, rules)
    if path[:1] == ["parameters"] and path[1:2] and path[1] not in rules[rule].spec.parameters:
        there = ", ".join(sorted(rules[rule].spec.parameters)) or "none"
        raise VariantError(f"{option} {text}: rule {rule} has no parameter {path[1]}; it has {there}")
    return rule, tuple(path), value.strip()


def _known(option: str, text: str, rule: str, rules: Mapping[str, EventRule]) -> str:
    """The name, if that rule exists."""
    if rule not in rules:
        hint = did_you_mean(rule, rules) or f"the rules are {', '.join(sorted(rules)) or 'none'}"
        raise VariantError(f"{option} {text}: there is no rule {rule}; {hint}")
    return rule


def _value(text: str) -> Any:
    """A YAML value: a number, a boolean, a list; otherwise text."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text


def _values(option: str, text: str) -> Iterator[Any]:
    """`80:200:20`, both ends included, or values separated by commas."""
    span = _RANGE.fullmatch(text)
    if span is None:
        yield from (_value(each.strip()) for each in text.split(","))
        return
    try:
        first, last, step = (float(part) for part in span.groups())
    except ValueError:
        raise VariantError(f"--sweep {option}: must be a range of numbers, first:last:step; got {text}") from None
    if step <= 0 or last < first:
        raise VariantError(f"--sweep {option}: must be first:last:step, with step above 0 and last not below first")
    for number in range(int((last - first) / step + 1e-9) + 1):
        value = round(first + number * step, 9)
        yield int(value) if value == int(value) else value


def _variant(rule: EventRule, changes: Sequence[Change], taken: set[str]) -> Variant:
    document = copy.deepcopy(rule.model_dump(mode="json", by_alias=True, exclude_unset=True))
    number = 1
    while (name := f"{rule.name[:58]}-{number}") in taken:
        number += 1
    taken.add(name)
    document["metadata"]["name"] = name
    document["spec"].pop("actions", None)
    for change in changes:
        _set(document["spec"], change)
    label = ", ".join(change.label for change in changes)
    try:
        made = EventRule.model_validate(document)
    except ValidationError as error:
        (path, text), *_ = messages(error, document)
        raise VariantError(f"{rule.name} with {label}: {'.'.join(map(str, path))}: {text}") from None
    parameters = frozenset(each.path[1] for each in changes if each.path[0] == "parameters" and len(each.path) > 1)
    return Variant(rule.name, label, made, parameters)


def _set(spec: dict[str, Any], change: Change) -> None:
    here: Any = spec
    for step in change.path[:-1]:
        here = _below(here, step, change)
    last = change.path[-1]
    if isinstance(here, list):
        here[_index(here, last, change)] = change.value
    elif isinstance(here, dict):
        here[last] = change.value
    else:
        raise VariantError(f"{change.rule}: there is no field {'.'.join(change.path)}")


def _below(here: Any, step: str, change: Change) -> Any:
    if isinstance(here, list):
        return here[_index(here, step, change)]
    if isinstance(here, dict):
        return here.setdefault(step, {})
    raise VariantError(f"{change.rule}: there is no field {'.'.join(change.path)}")


def _index(items: Sequence[Any], step: str, change: Change) -> int:
    """The index of the item with that name or number."""
    for at, item in enumerate(items):
        if isinstance(item, Mapping) and item.get("name") == step:
            return at
    if step.isdigit() and int(step) < len(items):
        return int(step)
    names = ", ".join(str(item.get("name")) for item in items if isinstance(item, Mapping))
    raise VariantError(f"{change.rule}: {'.'.join(change.path)}: there is no {step}; the names are {names or 'none'}")
