"""Finds errors in EventRules and Detectors, as far as possible without the message types. Pure.

The same compiler that the detector runs checks here. A rule is checked with all Detectors that select it. What the rule
alone has, or has with every one of them, is its own fault; what only some have, what stands in a field of theirs, and
what is merely not there yet is a doubt.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from application_manager.core.findings.checks import BROKEN_RULE, RULE_NOT_READY, RULE_NOT_SELECTED
from application_manager.core.findings.findings import Findings
from wayside.api import Detector, EventRule
from wayside.findings import Finding
from wayside.rules import (
    RuleError,
    RuleProblem,
    compile_rule,
    dependency_problems,
    own_problems,
    place_problems,
    source_problems,
    stream_problems,
)


def selects(detector: Detector, rule: EventRule) -> bool:
    """Whether the detector evaluates the rule, which is in its namespace."""
    return detector.spec.rule_selector.matches(rule.metadata.labels)


def selecting(rule: EventRule, detectors: Sequence[Detector]) -> list[Detector]:
    """Those of the detectors, which are in the rule's namespace, that evaluate it, by name."""
    return sorted((each for each in detectors if selects(each, rule)), key=lambda each: each.name)


def rule_findings(
    rule: EventRule, detectors: Sequence[Detector], invalid: Sequence[str] = (), others: Sequence[EventRule] = ()
) -> Findings:
    """What is wrong with the rule, given the valid detectors and the other rules of its namespace.

    `invalid`: the names of its namespace's other detectors.
    """
    judges = selecting(rule, detectors)
    if not judges:
        unselected = Finding(RULE_NOT_SELECTED.name, _not_selected(rule, detectors, invalid), rule.name)
        return Findings(tuple(map(str, own_problems(rule))), (unselected,))
    having: dict[RuleProblem, list[str]] = {}  # problem → detectors with which the rule has it
    passing: set[RuleProblem] = set()
    for detector in judges:
        beside = [each for each in others if each.name != rule.name and selects(detector, each)]
        known = dependency_problems([rule, *beside]).get(rule.name, ())
        passing |= {each for each in known if _names_what_is_not_there(each, rule, beside)}
        for problem in dict.fromkeys(_compiled(rule, detector, known)):
            having.setdefault(problem, []).append(detector.name)
    own = {each for each in having if each.detector is None and each not in passing}
    # A rule that one detector can evaluate is a good one.
    refused = {name for each in own for name in having[each]} == {each.name for each in judges}
    problems: list[str] = []
    doubts: list[Finding] = []
    for problem, names in having.items():
        whose = "" if len(names) == len(judges) else f"with Detector {', '.join(names)}: "
        if refused and problem in own:
            problems.append(f"{whose}{problem}")
        else:
            doubts.append(Finding(RULE_NOT_READY.name, f"{whose}{problem}", rule.name))
    return Findings(tuple(problems), tuple(doubts))


def detector_findings(detector: Detector) -> Findings:
    """What is wrong with the detector."""
    problems = [
        str(problem) for index, stream in enumerate(detector.spec.streams) for problem in stream_problems(stream, index)
    ]
    return Findings((*problems, *map(str, source_problems(detector)), *map(str, place_problems(detector))))


def newly_wrong(rule: EventRule, new: Detector, old: Detector | None) -> tuple[Finding, ...]:
    """What is wrong with a rule, which is in order as far as others are concerned, since its detector is as `new`.

    Nothing where the detector does not select it, or where all was wrong with the `old` one as well, None if it is new.
    """
    if not selects(new, rule):
        return ()
    problems = _compiled(rule, new, ())
    if problems and old is not None and selects(old, rule):
        known = set(_compiled(rule, old, ()))
        problems = [each for each in problems if each not in known]
    return tuple(Finding(BROKEN_RULE.name, f"EventRule {rule.name}, {each}", rule.name) for each in problems)


def _compiled(rule: EventRule, detector: Detector, known: Sequence[RuleProblem]) -> Sequence[RuleProblem]:
    try:
        compile_rule(rule, detector, None, known)
    except RuleError as error:
        return error.problems
    return ()


def _names_what_is_not_there(problem: RuleProblem, rule: EventRule, beside: Sequence[EventRule]) -> bool:
    """Whether it is about a signal whose rule is not there; else it is about a circle."""
    match problem.path:
        case ("spec", "signals", int(index), "ruleName"):
            return rule.spec.signals[index].rule_name not in {rule.name, *(each.name for each in beside)}
    return False


def _not_selected(rule: EventRule, detectors: Sequence[Detector], invalid: Sequence[str]) -> str:
    remedy = "; or ".join(_remedies(detectors, invalid)) or "create a Detector"
    return f"no valid Detector in namespace {rule.namespace} selects the rule: {remedy}"


def _remedies(detectors: Sequence[Detector], invalid: Sequence[str]) -> Iterator[str]:
    wanted = [
        f"{each.name} selects {each.spec.rule_selector}" for each in sorted(detectors, key=lambda each: each.name)
    ]
    if wanted:
        yield f"correct metadata.labels: {'; '.join(wanted)}"
    yield from (f"correct Detector {name}; its status gives the error" for name in sorted(invalid))
