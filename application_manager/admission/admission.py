"""What the API server asks before it stores a template, rule or detector, answered from what the manager knows.

The answers are the findings that also make the conditions. What a rule has only with others (its Detectors, the rules
and templates that it names) is looked up again at the API server before it is said: a Detector that was applied a
moment before its rules may not have reached us yet.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, TypeVarTuple, Unpack

from application_manager.cluster.client import ApiError, Client, Object, Resource, Unreachable
from application_manager.core.findings.findings import Findings
from application_manager.core.findings.reviews import Request, Weight, answer, read
from application_manager.core.findings.rulefindings import detector_findings, newly_wrong, rule_findings
from application_manager.core.findings.templatefindings import template_findings
from application_manager.core.objects.policy import KindKey
from application_manager.knowledge.world import DETECTOR, EVENT_RULE, TEMPLATE, World
from application_manager.measures import Measures
from wayside.api import ApplicationTemplate, Detector, EventRule
from wayside.api.base import Kind
from wayside.api.documents import parse_object
from wayside.rules import depends, own_problems

LOOKING_UP = 3.0  # s for what is asked of the API server, which waits for us meanwhile
LOOKING_AT_RULES = 1.0  # s for the rules of a Detector that changes
_JUDGES = 2  # threads of their own, so that an object that takes long to judge holds up other questions alone

Given = TypeVarTuple("Given")
Found = TypeVar("Found")

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Admission:
    """Answers.

    Attributes:
        resources: where EventRules and Detectors live.
        observe: takes an object that was read.
        namespaces: those that the manager looks after; empty: all.
    """

    world: World
    client: Client
    resources: Mapping[KindKey, Resource]
    observe: Callable[[Object], None]
    measures: Measures
    namespaces: Collection[str] = ()
    _judges: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(_JUDGES, "admission"))

    async def review(self, asked: Any) -> Object:
        """The answer to an AdmissionReview. Raises ReviewError where it is none."""
        request = read(asked)
        looked_after = not self.namespaces or request.namespace in self.namespaces
        findings = Findings()
        if request.weight is not Weight.NONE and looked_after:
            findings = await self._findings(request)
        response = answer(request, findings)
        told = response["response"]
        verdict = "refused" if not told["allowed"] else "warned" if "warnings" in told else "allowed"
        self.measures.reviewed(request.kind, verdict)
        if verdict == "refused":
            status = told["status"]
            name = status["details"]["name"]
            log.info("%s %s/%s is refused: %s", request.kind, request.namespace, name, status["message"])
        return response

    async def _findings(self, request: Request) -> Findings:
        try:
            model = parse_object(request.object)
        except ValueError as error:
            return Findings((str(error),))
        match model:
            case ApplicationTemplate():
                return await self._beside(template_findings, model, self.world.policy)
            case EventRule():
                return await self._of_rule(model)
            case Detector():
                return await self._of_detector(model, _parsed(request.old))
        return Findings()

    async def _of_rule(self, rule: EventRule) -> Findings:
        findings = await self._judged(rule)
        if not findings.all:
            return findings
        own = await self._beside(own_problems, rule)
        if own:
            return findings
        try:
            async with asyncio.timeout(LOOKING_UP):
                await self._look_up(DETECTOR, rule.namespace)
                if depends(rule):
                    await self._look_up(EVENT_RULE, rule.namespace)
                if findings.remarks:
                    await self._look_up(TEMPLATE, rule.namespace)
        except (ApiError, Unreachable, TimeoutError) as error:
            log.warning("EventRule %s/%s is judged by what is known: %s", rule.namespace, rule.name, error)
            return Findings((), findings.faults, findings.remarks)
        return await self._judged(rule)

    async def _judged(self, rule: EventRule) -> Findings:
        detectors = self.world.models(DETECTOR, Detector, rule.namespace)
        others = self.world.models(EVENT_RULE, EventRule, rule.namespace) if depends(rule) else []
        invalid, remarks = self.world.invalid(DETECTOR, rule.namespace), tuple(self.world.deploy_remarks(rule))
        return replace(await self._beside(rule_findings, rule, detectors, invalid, others), remarks=remarks)

    async def _beside(self, judge: Callable[[Unpack[Given]], Found], *given: *Given) -> Found:
        """Judge in a thread, few at a time: what runs goes before what may come."""
        return await asyncio.get_running_loop().run_in_executor(self._judges, judge, *given)

    async def _look_up(self, kind: KindKey, namespace: str) -> None:
        for raw in (await self.client.list(self.resources[kind], namespace))[0]:
            self.observe(raw)

    async def _of_detector(self, detector: Detector, old: Kind | None) -> Findings:
        """What is wrong with the detector; that rules of it no longer compile is a remark, since they may follow."""
        findings = await self._beside(detector_findings, detector)
        remarks: list[str] = []
        until = time.monotonic() + LOOKING_AT_RULES
        for rule in self.world.models(EVENT_RULE, EventRule, detector.namespace):
            remarks += await self._beside(newly_wrong, rule, detector, old if isinstance(old, Detector) else None)
            if time.monotonic() > until:
                remarks.append("not all of its rules were looked at: their statuses will say whether they are in order")
                break
        return replace(findings, remarks=tuple(remarks))


def _parsed(raw: Object | None) -> Kind | None:
    """The object as its kind; None where it is none."""
    try:
        return parse_object(raw) if raw is not None else None
    except ValueError:
        return None
