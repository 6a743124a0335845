"""The keys of results: the content of the recording, and a digest of everything that affects a rule's result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from detector.replay.clips import RECORD
from wayside.api import Detector, EventRule

_LAYOUT = 2
"""The version of the cached layout: results of earlier versions are not read."""


def rule_keys(detector: Detector, rules: Sequence[EventRule]) -> dict[str, str]:
    """By rule, a digest of it, of the rules that it reads, its models, the Detector with its maps, and this version.

    The rules have the actions that run (see `mined_rule`).
    """
    named = {rule.name: rule for rule in rules}
    common = [_LAYOUT, version("wayside"), detector.name, detector.namespace, detector.spec.model_dump(mode="json")]
    common += [_digest(Path(each.file)) for each in detector.spec.maps]
    keys = {}
    for rule in rules:
        seen = sorted(with_dependencies([rule.name], named))
        whole = [*common, [_document(named[name]) for name in seen]]
        keys[rule.name] = hashlib.blake2b(json.dumps(whole, sort_keys=True).encode(), digest_size=16).hexdigest()
    return keys


def mined_rule(rule: EventRule, *, record: bool) -> EventRule:
    """The rule without actions, except record actions if they run: no other affects the result."""
    actions = [action for action in rule.spec.actions if record and action.field == RECORD]
    return rule.model_copy(update={"spec": rule.spec.model_copy(update={"actions": actions})})


def records(rule: EventRule) -> bool:
    """Whether the rule has a record action."""
    return any(action.field == RECORD for action in rule.spec.actions)


def with_dependencies(names: Iterable[str], rules: Mapping[str, EventRule]) -> set[str]:
    """The rules, and those that their signals read, directly or indirectly. Missing ones are left out."""
    found: set[str] = set()
    left = [*names]
    while left:
        name = left.pop()
        if name in rules and name not in found:
            found.add(name)
            left += [signal.rule_name for signal in rules[name].spec.signals if signal.rule_name is not None]
    return found


def _document(rule: EventRule) -> object:
    """Everything in the rule that affects the result, with the content of its models."""
    files = [signal.model.file for signal in rule.spec.signals if signal.model is not None]
    return [rule.name, rule.spec.model_dump(mode="json"), [_digest(Path(file)) for file in files]]


def _digest(path: Path) -> str:
    try:
        return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()
    except OSError as error:
        return str(error)  # the rule is rejected
