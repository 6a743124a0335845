"""A Detector with the EventRules that it selects."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from wayside.api import Detector, EventRule


@dataclass(frozen=True)
class RuleSet:
    """The input of the engine."""

    detector: Detector
    rules: tuple[EventRule, ...]
    """Those that the detector selects, by name."""

    def same_as(self, other: RuleSet | None) -> bool:
        """Whether both are equal to the engine; status and similar fields are ignored."""
        return other is not None and _essence(self) == _essence(other)


def select(detector: Detector, rules: Iterable[EventRule]) -> RuleSet:
    """The rules of the detector's namespace whose labels match its selector, by name."""
    chosen = [
        rule
        for rule in rules
        if rule.namespace == detector.namespace and detector.spec.rule_selector.matches(rule.metadata.labels)
    ]
    return RuleSet(detector, tuple(sorted(chosen, key=lambda rule: rule.name)))


def _essence(rules: RuleSet) -> tuple[object, ...]:
    return (rules.detector.name, rules.detector.spec, [(rule.name, rule.spec) for rule in rules.rules])
