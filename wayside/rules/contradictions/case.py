"""A rule with its classification: the input of the checks for contradictions, and the form of their warnings."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from wayside.api import Detector, EventRule
from wayside.api.base import Duration
from wayside.api.classification import CharacteristicValue, Classification, dimension_of
from wayside.api.eventrule import Signal
from wayside.rules.compiled import CompiledRule
from wayside.rules.problems import RuleProblem

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(frozen=True)
class Case:
    """A rule that compiles, with its Detector and the rules that it names."""

    rule: EventRule
    compiled: CompiledRule
    detector: Detector
    others: Mapping[str, EventRule]
    """The rules that it can name, by name."""

    def given(self, values: type[CharacteristicValue]) -> list[CharacteristicValue]:
        """The values of the classification in the dimension; empty if it has none."""
        classification = self.rule.spec.classification or Classification()
        return classification.values_of(dimension_of(values))

    def only(self, *values: CharacteristicValue) -> bool:
        """Whether the classification has values in the dimension, and only these."""
        given = self.given(type(values[0]))
        return bool(given) and set(given) <= set(values)

    def against(self, value: CharacteristicValue, fact: str) -> RuleProblem:
        """The warning that a given value contradicts the fact; the fact also contains the remedy."""
        dimension = dimension_of(type(value))
        index = self.given(type(value)).index(value)
        return RuleProblem(
            ("spec", "classification", dimension.name, index), f"{value.explained()} contradicts the rule: {fact}"
        )

    def lacks(self, values: type[CharacteristicValue], fact: str) -> RuleProblem:
        """The warning that a value is missing in a dimension; the fact names the value."""
        return RuleProblem(("spec", "classification", dimension_of(values).name), fact)


def conditions(rule: EventRule) -> Iterator[str]:
    """The expressions that start and end episodes, or select their subjects."""
    spec, scope = rule.spec, rule.spec.scope
    yield spec.when
    if spec.until is not None:
        yield spec.until
    for role in (scope.client, scope.pairs, *((scope.pairs.a, scope.pairs.b) if scope.pairs is not None else ())):
        if role is not None and role.where is not None:
            yield role.where
    if scope.fleet is not None:
        yield scope.fleet.members


def detecting(rule: EventRule) -> Iterator[tuple[int, Signal]]:
    """The signals that decide about episodes, with their indices; without those that only actions read.

    A signal decides if its name is in a condition or in the scope, or if it goes into a model or signal that decides.
    """
    spec = rule.spec
    names = {name for condition in conditions(rule) for name in _NAME.findall(condition)}
    for model in [signal.model for signal in spec.signals if signal.name in names]:
        if model is not None:
            names |= {name for each in model.inputs for name in each.signals}
    of = {signal.name: set(_NAME.findall(signal.of)) for signal in spec.signals if signal.of is not None}
    while more := {name for each in names & of.keys() for name in of[each]} - names:
        names |= more
    return ((index, signal) for index, signal in enumerate(spec.signals) if signal.name in names)


def span(nanoseconds: int) -> str:
    """A duration in the syntax of fields."""
    for unit, factor in (("h", 3_600 * 10**9), ("m", 60 * 10**9), ("s", 10**9)):
        if nanoseconds >= factor and nanoseconds % factor == 0:
            return str(Duration(f"{nanoseconds // factor}{unit}"))
    return str(Duration(f"{nanoseconds // 10**6}ms"))
