"""Finds errors in EventRules and Detectors, as far as possible without the message types. Pure.

The compiler of the detector checks them here too. A rule is checked with all Detectors that select it. A problem of the
rule alone, or with every one of them, is an error of the rule. A problem with only some of them, a problem in a field
of a Detector, and a reference to a rule that does not exist yet are doubts.

If a template would refuse its deploy actions, that is only a remark: the rule is valid, and the template may still
change. Values of `${…}` are unknown before the episode, so only the names of these parameters are checked.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from application_manager.core.claims import parameters
from application_manager.core.findings.checks import (
    BROKEN_RULE,
    DEPLOY_PARAMETERS,
    RULE_NOT_READY,
    RULE_NOT_SELECTED,
    UNKNOWN_TEMPLATE,
)
from application_manager.core.findings.findings import Findings
from wayside.api import ApplicationTemplate, Detector, EventRule
from wayside.api.actions.deploy import Deploy
from wayside.api.operation import Operation
from wayside.findings import Finding, ignored_by
from wayside.names import did_you_mean
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
    """Whether the Detector, in the namespace of the rule, selects the rule."""
    return detector.spec.rule_selector.matches(rule.metadata.labels)


def selecting(rule: EventRule, detectors: Sequence[Detector]) -> list[Detector]:
    """The Detectors, in the namespace of the rule, that select the rule, by name."""
    return sorted((each for each in detectors if selects(each, rule)), key=lambda each: each.name)


def rule_findings(
    rule: EventRule, detectors: Sequence[Detector], invalid: Sequence[str] = (), others: Sequence[EventRule] = ()
) -> Findings:
    """The findings about the rule, given the valid Detectors and the other rules of its namespace.

    `invalid`: the names of the namespace's other Detectors.
    """
    selected_by = selecting(rule, detectors)
    if not selected_by:
        unselected = Finding(RULE_NOT_SELECTED.name, _not_selected(rule, detectors, invalid), rule.name)
        return Findings(tuple(map(str, own_problems(rule))), (unselected,))
    having: dict[RuleProblem, list[str]] = {}  # problem → detectors with which the rule has it
    passing: set[RuleProblem] = set()
    for detector in selected_by:
        beside = [each for each in others if each.name != rule.name and selects(detector, each)]
        known = dependency_problems([rule, *beside]).get(rule.name, ())
        passing |= {each for each in known if _names_missing_rule(each, rule, beside)}
        for problem in dict.fromkeys(_compiled(rule, detector, known)):
            having.setdefault(problem, []).append(detector.name)
    own = {each for each in having if each.detector is None and each not in passing}
    # One Detector that can evaluate the rule is enough.
    refused = {name for each in own for name in having[each]} == {each.name for each in selected_by}
    problems: list[str] = []
    doubts: list[Finding] = []
    for problem, names in having.items():
        whose = "" if len(names) == len(selected_by) else f"with Detector {', '.join(names)}: "
        if refused and problem in own:
            problems.append(f"{whose}{problem}")
        else:
            doubts.append(Finding(RULE_NOT_READY.name, f"{whose}{problem}", rule.name))
    return Findings(tuple(problems), tuple(doubts))


@dataclass(frozen=True, slots=True)
class RuleContext:
    """The context of a rule: the valid objects of its namespace, and the names of the invalid ones."""

    detectors: Sequence[Detector] = ()
    invalid_detectors: Sequence[str] = ()
    rules: Sequence[EventRule] = ()
    templates: Sequence[ApplicationTemplate] = ()
    invalid_templates: Sequence[str] = ()

    def findings(self, rule: EventRule) -> Findings:
        """The findings about the rule, and why its tasks would be refused."""
        found = rule_findings(rule, self.detectors, self.invalid_detectors, self.rules)
        return replace(found, remarks=tuple(deploy_remarks(rule, self.templates, self.invalid_templates)))


def detector_findings(detector: Detector) -> Findings:
    """The findings about the Detector."""
    problems = [
        str(problem) for index, stream in enumerate(detector.spec.streams) for problem in stream_problems(stream, index)
    ]
    return Findings((*problems, *map(str, source_problems(detector)), *map(str, place_problems(detector))))


def newly_wrong(rule: EventRule, new: Detector, old: Detector | None) -> tuple[Finding, ...]:
    """The problems of a rule with the changed Detector `new` that it did not have with `old`.

    Empty if the Detector does not select the rule. `old` is None for a new Detector.
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


def _names_missing_rule(problem: RuleProblem, rule: EventRule, beside: Sequence[EventRule]) -> bool:
    """Whether the problem is a signal whose rule does not exist; otherwise it is a cycle."""
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


def deploy_remarks(
    rule: EventRule, templates: Iterable[ApplicationTemplate], invalid: Iterable[str] = ()
) -> list[Finding]:
    """Why the tasks of the rule would be refused, without the findings that its annotation ignores.

    `templates`: the valid ones of its namespace; `invalid`: the names of the others.
    """
    known, others = {each.name: each for each in templates}, set(invalid)
    found: list[Finding] = []
    for index, action in enumerate(rule.spec.actions):
        if action.deploy is None or action.deploy.template_name in others:
            continue
        where = f"spec.actions[{index}].deploy"
        template = known.get(action.deploy.template_name)
        if template is None:
            similar = did_you_mean(action.deploy.template_name, [*known, *others])
            remedy = similar or "create it; until then, tasks of this rule are refused"
            missing = (
                f"there is no ApplicationTemplate {action.deploy.template_name} in namespace {rule.namespace}: {remedy}"
            )
            found.append(Finding(UNKNOWN_TEMPLATE.name, f"{where}.templateName: {missing}", rule.name))
        else:
            for each in _of_parameters(action.deploy, template, f"{where}.parameters"):
                found.append(Finding(DEPLOY_PARAMETERS.name, each, rule.name))
    ignored = ignored_by(rule.metadata.annotations)
    return [each for each in found if each.check not in ignored]


def _of_parameters(deploy: Deploy, template: ApplicationTemplate, where: str) -> Iterator[str]:
    declared, given = template.spec.parameters, deploy.parameters
    literal = {name: each for name, each in given.items() if name not in declared or "${" not in json.dumps(each)}
    yield from parameters.problems(declared, literal, template.name, where, whole=False)
    if deploy.operation is Operation.DEPLOY:
        for name, parameter in declared.items():
            if parameter.required and given.get(name) is None:
                yield f"{where}.{name}: is missing, and template {template.name} requires it: give a {parameter.type}"
