"""The jobs of the worker processes: everything that compiles or evaluates expressions of users.

Each job is data, and its result follows from it alone. A template travels as bytes, since a process that has compiled
it before need not read it again.
"""

from __future__ import annotations

import pickle
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

from application_manager.core.claims.claims import Claim, Refusal, claim
from application_manager.core.conditions import Aspect
from application_manager.core.findings.demanding import deploy_remarks
from application_manager.core.findings.findings import Findings
from application_manager.core.findings.rulefindings import detector_findings, newly_wrong, rule_findings
from application_manager.core.findings.templatefindings import template_findings
from application_manager.core.objects.charts import ChartOutcome, ChartRequest
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer, RenderError, Rendering
from application_manager.core.statuses.rulestatus import detector_status, rule_status
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate, Detector, EventRule
from wayside.api.detector import DetectorStatus
from wayside.api.eventrule import EventRuleStatus
from wayside.findings import Finding

_COMPILED = 64  # templates that a process keeps compiled

_renderers: OrderedDict[tuple[str, int], Renderer | RenderError] = OrderedDict()


@dataclass(frozen=True, slots=True)
class RenderProblem:
    """Why an instance has no objects: as the condition Applied gives it."""

    reason: str
    message: str


@dataclass(frozen=True, slots=True)
class RenderJob:
    """An instance's objects.

    Attributes:
        uid, generation: the template's.
        template: the template, pickled.
        chart: what became of the instance's chart, where that was requested.
    """

    uid: str
    generation: int
    template: bytes
    policy: Policy
    instance: ApplicationInstance
    chart: ChartOutcome | None = None

    def run(self) -> Rendering | RenderProblem | ChartRequest:
        """The objects, or why there are none, or the chart that is to be rendered first."""
        requested: list[ChartRequest] = []

        def charts(request: ChartRequest) -> ChartOutcome:
            requested.append(request)
            if self.chart is None:
                raise _ChartWantedError
            return self.chart

        try:
            return self._renderer().render(self.instance, charts)
        except _ChartWantedError:
            return requested[0]
        except RenderError as error:
            return RenderProblem(error.reason, str(error))

    def _renderer(self) -> Renderer:
        # The policy is the same for all jobs of a manager.
        key = (self.uid, self.generation)
        known = _renderers.get(key)
        if known is None:
            template: ApplicationTemplate = pickle.loads(self.template)  # noqa: S301  from the manager
            try:
                known = Renderer(template, self.policy)
            except RenderError as error:
                known = error
            _renderers[key] = known
            while len(_renderers) > _COMPILED:
                _renderers.popitem(last=False)
        _renderers.move_to_end(key)
        if isinstance(known, RenderError):
            raise known
        return known


class _ChartWantedError(Exception):
    """The chart's objects are wanted, and not there yet."""


@dataclass(frozen=True, slots=True)
class ClaimJob:
    """What a task requests of its template."""

    template: ApplicationTemplate
    task: ApplicationTask

    def run(self) -> Claim | Refusal:
        """The claim, or why the task cannot be served."""
        return claim(self.template, self.task)


@dataclass(frozen=True, slots=True)
class TemplateJob:
    """What is wrong with a template."""

    template: ApplicationTemplate
    policy: Policy

    def run(self) -> Findings:
        """The findings."""
        return template_findings(self.template, self.policy)


@dataclass(frozen=True, slots=True)
class RuleContext:
    """What a rule is checked with: the valid objects of its namespace, and the names of the others."""

    detectors: Sequence[Detector] = ()
    invalid_detectors: Sequence[str] = ()
    rules: Sequence[EventRule] = ()
    templates: Sequence[ApplicationTemplate] = ()
    invalid_templates: Sequence[str] = ()


@dataclass(frozen=True, slots=True)
class RuleJob:
    """What is wrong with a rule."""

    rule: EventRule
    among: RuleContext

    def run(self) -> Findings:
        """The findings."""
        found = rule_findings(self.rule, self.among.detectors, self.among.invalid_detectors, self.among.rules)
        return replace(found, remarks=tuple(self.remarks()))

    def remarks(self) -> list[Finding]:
        """What the rule's tasks would be refused for."""
        return deploy_remarks(self.rule, self.among.templates, self.among.invalid_templates)


@dataclass(frozen=True, slots=True)
class RuleStatusJob:
    """A rule's status as of `now`, in seconds since 1970."""

    judged: RuleJob
    now: float

    def run(self) -> EventRuleStatus:
        """The status."""
        among, remarks = self.judged.among, self.judged.remarks()
        rule = self.judged.rule
        return rule_status(rule, among.detectors, self.now, among.invalid_detectors, among.rules, remarks)


@dataclass(frozen=True, slots=True)
class DetectorJob:
    """What is wrong with a detector; and what is newly wrong with its rules, where there are any to look at."""

    detector: Detector
    old: Detector | None = None
    rules: Sequence[EventRule] = ()

    def run(self) -> Findings:
        """The findings; what is wrong with rules is a remark, since they may follow."""
        remarks = [each for rule in self.rules for each in newly_wrong(rule, self.detector, self.old)]
        return replace(detector_findings(self.detector), remarks=tuple(remarks))


@dataclass(frozen=True, slots=True)
class DetectorStatusJob:
    """A detector's status as of `now`, in seconds since 1970."""

    detector: Detector
    rules: Sequence[EventRule]
    now: float
    running: Aspect | None

    def run(self) -> DetectorStatus:
        """The status."""
        return detector_status(self.detector, self.rules, self.now, self.running)
