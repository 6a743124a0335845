"""What a rule's deploy actions require of templates, checked before any task is emitted. Pure.

The rule is in order all the same, and a template may yet come or change: so these are remarks, and nothing is refused.
What `${…}` will be nobody knows before the episode, so of these parameters only the names are looked at.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Iterator

from application_manager.core.claims import parameters
from application_manager.core.findings.checks import DEPLOY_PARAMETERS, UNKNOWN_TEMPLATE
from wayside.api import ApplicationTemplate, EventRule
from wayside.api.actions.deploy import Deploy
from wayside.api.operation import Operation
from wayside.findings import Finding, ignored_by


def deploy_remarks(
    rule: EventRule, templates: Iterable[ApplicationTemplate], invalid: Iterable[str] = ()
) -> list[Finding]:
    """What the tasks of the rule would be refused for, without what its annotation ignores.

    `templates`: those of its namespace that are valid; `invalid`: the names of the others.
    """
    known, others = {each.name: each for each in templates}, set(invalid)
    found: list[Finding] = []
    for index, action in enumerate(rule.spec.actions):
        if action.deploy is None or action.deploy.template_name in others:
            continue
        where = f"spec.actions[{index}].deploy"
        template = known.get(action.deploy.template_name)
        if template is None:
            close = difflib.get_close_matches(action.deploy.template_name, [*known, *others], n=1)
            remedy = f"did you mean {close[0]}?" if close else "create it, or tasks of this rule are refused"
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
