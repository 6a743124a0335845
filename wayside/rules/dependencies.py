"""Rules over rules: the dependencies of rules, their order of evaluation, and the problems of both.

The samples of a signal can be the episodes of another rule. Within a tick, a rule is evaluated after the rules that it
names: its depth is 0 if it names none, otherwise one more than the greatest depth of these.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from wayside.api import EventRule
from wayside.names import did_you_mean
from wayside.rules.compiled import CompiledRule
from wayside.rules.problems import RuleProblem


def in_order(rules: Iterable[CompiledRule]) -> list[CompiledRule]:
    """The rules in the order of evaluation within a tick: by depth, then by name.

    Unknown rules are ignored, and so are dependencies that close a cycle. (Only rules whose last valid version stays
    active can form a cycle: `dependency_problems` refuses all others.)
    """
    named = {rule.name: [signal.rule for signal in rule.signals if signal.rule is not None] for rule in rules}
    depths: dict[str, int] = {}

    def depth(name: str, above: tuple[str, ...]) -> int:
        if name not in depths:
            below = [
                depth(each, (*above, name)) for each in named[name] if each in named and each not in (*above, name)
            ]
            depths[name] = 1 + max(below, default=-1)
        return depths[name]

    return sorted(rules, key=lambda rule: (depth(rule.name, ()), rule.name))


def dependency_problems(rules: Sequence[EventRule]) -> dict[str, list[RuleProblem]]:
    """The problems by rule: signals that name an unknown rule, and cycles."""
    problems: dict[str, list[RuleProblem]] = {}
    named = {rule.name: dict(_named(rule)) for rule in rules}
    for name, signals in named.items():
        for index, other in signals.items():
            if other not in named:
                message = _unknown(other, [each for each in named if each != name])
            elif cycle := _way(other, name, named):
                message = (
                    f"rules must not depend on each other in a cycle: {' → '.join((name, *cycle))}; "
                    "remove one of these signals"
                )
            else:
                continue
            problems.setdefault(name, []).append(RuleProblem(("spec", "signals", index, "ruleName"), message))
    return problems


def depends(rule: EventRule) -> bool:
    """Whether a signal of the rule names another rule."""
    return any(True for _ in _named(rule))


def _named(rule: EventRule) -> Iterator[tuple[int, str]]:
    return ((index, signal.rule_name) for index, signal in enumerate(rule.spec.signals) if signal.rule_name is not None)


def _unknown(name: str, others: Sequence[str]) -> str:
    hint = did_you_mean(name, others) or f"the others are {', '.join(sorted(others)) or 'none'}"
    return f"there is no rule {name} that the same Detector selects; {hint}"


def _way(start: str, end: str, named: Mapping[str, Mapping[int, str]]) -> tuple[str, ...]:
    """The shortest path along dependencies from one rule to another, including both; empty if there is none."""
    ways: list[tuple[str, ...]] = [(start,)]
    seen = {start}
    for way in ways:
        if way[-1] == end:
            return way
        for other in named.get(way[-1], {}).values():
            if other not in seen:
                seen.add(other)
                ways.append((*way, other))
    return ()
