"""The jobs of the worker processes, for everything that compiles or evaluates users' expressions.

A job is a function and its arguments, on which alone its result depends. A template is passed as bytes, so that a
process that has compiled it before need not parse it again. The manager itself evaluates only small templates whose
expressions only read fields: `${parameters.region}` costs no more than sending it, and two switches between processes
cost more than the work.
"""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

from application_manager.core.findings.findings import Findings
from application_manager.core.findings.rulefindings import detector_findings, newly_wrong
from application_manager.core.objects.charts import ChartOutcome, ChartRequest
from application_manager.core.objects.ownership import ApplyProblem
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import ChartPending, Renderer, RenderError, Rendering
from wayside.api import ApplicationInstance, ApplicationTemplate, Detector, EventRule

_COMPILED = 64  # compiled templates that a process keeps
_READ = re.compile(r"\$\{\s*(?:parameters|instance)(?:\.[A-Za-z_]\w*)+\s*\}")
_LARGEST = 32 * 1024  # characters of the objects and files of a small template
_MOST = 256  # expressions in them
_VALUES = 16 * 1024  # characters of the values: with the above, 4 MB at most


def render_instance(
    template: bytes, policy: Policy, instance: ApplicationInstance, chart: ChartOutcome | None = None
) -> Rendering | ApplyProblem | ChartRequest:
    """An instance's objects, or why there are none, or the chart that is to be rendered first.

    `template` is pickled; `chart` is the result for the instance's chart, if it was requested.
    """
    compiled = _compiled(template, policy)
    if isinstance(compiled, ApplyProblem):
        return compiled
    try:
        return compiled.render(instance, lambda _: chart)
    except ChartPending as pending:
        return pending.request
    except RenderError as error:
        return ApplyProblem(error.reason, str(error))


@lru_cache(maxsize=_COMPILED)
def _compiled(template: bytes, policy: Policy) -> Renderer | ApplyProblem:
    try:
        return Renderer(pickle.loads(template), policy)  # noqa: S301  from the manager
    except RenderError as error:
        return ApplyProblem(error.reason, str(error))


def check_detector(detector: Detector, old: Detector | None = None, rules: Sequence[EventRule] = ()) -> Findings:
    """The findings about a detector; new problems of these rules are remarks, because they may be changed next."""
    remarks = [each for rule in rules for each in newly_wrong(rule, detector, old)]
    return replace(detector_findings(detector), remarks=tuple(remarks))


def claims_are_plain(template: ApplicationTemplate) -> bool:
    """Whether the claims of the template's tasks need no expressions except plain reads of parameters."""
    patterns = (each.pattern for each in template.spec.parameters.values())
    return _reads_alone(template.spec.key or "") and all(each is None for each in patterns)


def objects_are_plain(template: ApplicationTemplate) -> bool:
    """Whether the template's objects need only a few such expressions."""
    if template.spec.helm is not None:
        return False
    text = _text([template.spec.manifests, template.spec.configuration])
    return len(text) <= _LARGEST and text.count("${") <= _MOST and _reads_alone(text)


def values_are_small(instance: ApplicationInstance) -> bool:
    """Whether the instance's values are so small that reading them many times gives a small result."""
    return len(_text(instance.spec.parameters)) <= _VALUES


def _reads_alone(text: str) -> bool:
    """Whether all expressions in the text only read a parameter or a field of the instance."""
    return "${" not in _READ.sub("", text)


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, default=str)
