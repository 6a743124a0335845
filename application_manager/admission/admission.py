"""Reviews templates, rules and Detectors before the API server stores them, and injects detectors into pods.

The responses contain the same findings as the conditions. If a finding of a rule depends on other objects (its
Detectors, the rules and templates that it names), these objects are read from the API server again before it is
reported: the watches may not have delivered a Detector that was applied just before its rules. A pod's Detector is also
read again before the pod is created without it. On any other failure there is no response, and the pod is created
without its detector (failurePolicy Ignore).
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from application_manager.cache.cluster_cache import (
    DETECTORS,
    EVENT_RULE,
    EVENT_RULES,
    TEMPLATES,
    ClusterCache,
    rule_context,
)
from application_manager.core.findings.checks import BROKEN_RULE, INVALID_RULE
from application_manager.core.findings.findings import Findings
from application_manager.core.findings.injections import (
    Injection,
    PodRequest,
    answer_pod,
    detector_of,
    injection,
    read_pod,
)
from application_manager.core.findings.reviews import OverloadedError, Request, ReviewEffect, answer, read
from application_manager.core.findings.rulefindings import RuleContext
from application_manager.core.findings.templatefindings import template_findings
from application_manager.core.objects.detectors import deployment_to_try
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.measures import Measures
from application_manager.workers.jobs import check_detector
from application_manager.workers.pool import ExceededError, Runs
from application_manager.workers.process import Job
from wayside.api import ApplicationTemplate, Detector, EventRule
from wayside.api.base import Kind
from wayside.api.documents import parse_object
from wayside.api.pod import DetectorMode
from wayside.findings import Finding
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, Unreachable
from wayside.kubernetes.resources import Object, Resource
from wayside.rules import depends

AT_ONCE = 8
"""The maximum number of concurrent reviews in one namespace; further ones are rejected."""

LOOKUP_TIMEOUT = 3.0  # s for requests to the API server, which waits for our response
RULES_TIMEOUT = 1.0  # s for the rules of a changed Detector
_RULES_AT_ONCE = 20  # of these in one job: the limit of CPU time applies to each job

_DEPLOYMENTS = Resource("apps/v1", "Deployment", "deployments")
_FORBIDDEN = 403

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Admission:
    """Responds to reviews. `namespaces`: the managed ones, empty for all; `defaults`: None if it runs no detectors."""

    cache: ClusterCache
    client: Client
    observe: Callable[[Object], None]
    measures: Measures
    pool: Runs
    namespaces: Collection[str] = ()
    defaults: PodDefaults | None = None
    _in_progress: Counter[str] = field(default_factory=Counter)

    async def review(self, review: Any) -> Object:
        """The response to an AdmissionReview. Raises ReviewError if it is not valid, and OverloadedError."""
        request = read(review)
        is_managed = not self.namespaces or request.namespace in self.namespaces
        findings = Findings()
        if request.effect is not ReviewEffect.NONE and is_managed:
            findings = await self._in_turn(request)
        response = answer(request, findings)
        given = response["response"]
        verdict = "refused" if not given["allowed"] else "warned" if "warnings" in given else "allowed"
        self.measures.reviewed(request.kind, verdict)
        if verdict == "refused":
            status = given["status"]
            name = status["details"]["name"]
            log.info("%s %s/%s is refused: %s", request.kind, request.namespace, name, status["message"])
        return response

    async def _in_turn(self, request: Request) -> Findings:
        """The findings. Raises OverloadedError if the namespace has too many reviews in progress."""
        if self._in_progress[request.namespace] >= AT_ONCE:
            raise OverloadedError(f"{AT_ONCE} reviews of namespace {request.namespace} are in progress: try again")
        self._in_progress[request.namespace] += 1
        try:
            return await self._findings(request)
        finally:
            self._in_progress.subtract((request.namespace,))
            if not self._in_progress[request.namespace]:
                del self._in_progress[request.namespace]

    async def _findings(self, request: Request) -> Findings:
        try:
            model = parse_object(request.object)
        except ValueError as error:
            return Findings((str(error),))
        match model:
            case ApplicationTemplate():
                return await self._run(request.namespace, partial(template_findings, model, self.cache.policy))
            case EventRule():
                return await self._of_rule(model)
            case Detector():
                return await self._of_detector(model, _parsed(request.old))
        return Findings()

    async def _of_rule(self, rule: EventRule) -> Findings:
        findings = await self._check(rule)
        if findings == Findings():
            return findings
        if (await self._run(rule.namespace, partial(RuleContext().findings, rule))).problems:
            return findings  # it has them by itself
        try:
            async with asyncio.timeout(LOOKUP_TIMEOUT):
                await self._look_up(DETECTORS, rule.namespace)
                if depends(rule):
                    await self._look_up(EVENT_RULES, rule.namespace)
                if findings.remarks:
                    await self._look_up(TEMPLATES, rule.namespace)
        except (ApiError, Unreachable, TimeoutError) as error:
            log.warning("EventRule %s/%s: reviewed against the cache only: %s", rule.namespace, rule.name, error)
            problems = (Finding(INVALID_RULE.name, each, rule.name) for each in findings.problems)
            return Findings((), (*problems, *findings.doubts), findings.remarks)
        return await self._check(rule)

    async def _check(self, rule: EventRule) -> Findings:
        return await self._run(rule.namespace, partial(rule_context(self.cache, rule).findings, rule))

    async def _run(self, namespace: str, job: Job[Findings]) -> Findings:
        """The findings of a worker process; an exceeded limit of CPU time is a problem as well."""
        try:
            return await self.pool.run(namespace, job)
        except ExceededError as error:
            return Findings((f"spec: the review {error}",))

    async def _look_up(self, resource: Resource, namespace: str, fields: str = "") -> None:
        for raw in (await self.client.list(resource, namespace, fields=fields))[0]:
            self.observe(raw)

    async def _of_detector(self, detector: Detector, old: Kind | None) -> Findings:
        """The findings about the Detector. Rules that no longer compile are remarks: they may be changed next."""
        before = old if isinstance(old, Detector) else None
        findings = await self._run(detector.namespace, partial(check_detector, detector))
        if not findings.problems and (problem := await self._pod_problem(detector, before)):
            return replace(findings, problems=(problem,))
        remarks: list[Finding] = []
        until = time.monotonic() + RULES_TIMEOUT
        rules = self.cache.models(EVENT_RULE, EventRule, detector.namespace)
        for first in range(0, len(rules), _RULES_AT_ONCE):
            some = rules[first : first + _RULES_AT_ONCE]
            remarks += (await self._run(detector.namespace, partial(check_detector, detector, before, some))).remarks
            if time.monotonic() > until and first + _RULES_AT_ONCE < len(rules):
                unseen = "not all of its rules were reviewed: see their statuses"
                remarks.append(Finding(BROKEN_RULE.name, unseen))
                break
        return replace(findings, remarks=tuple(remarks))

    async def _pod_problem(self, detector: Detector, before: Detector | None) -> str:
        """Why the API server would refuse the detector's Deployment; empty if it would not, or does not respond."""
        spec, old = detector.spec, before.spec if before is not None else None
        unchanged = old is not None and (old.mode, old.pod) == (spec.mode, spec.pod)
        if self.defaults is None or spec.mode is not DetectorMode.STANDALONE or spec.pod is None or unchanged:
            return ""
        problem = ""
        try:
            async with asyncio.timeout(LOOKUP_TIMEOUT):
                await self.client.apply(_DEPLOYMENTS, deployment_to_try(detector, self.defaults), dry_run=True)
        except ApiError as error:
            if error.permanent and error.code != _FORBIDDEN:
                problem = f"spec.pod: {error.message}"
        except (Unreachable, TimeoutError) as error:
            log.warning(
                "Detector %s/%s: cannot check its pod with a dry run: %s", detector.namespace, detector.name, error
            )
        return problem

    async def inject(self, review: Any) -> Object:
        """The response to an AdmissionReview about a pod. Raises ReviewError if it is not valid."""
        request = read_pod(review)
        name = detector_of(request.pod.get("metadata"))
        if name is None:
            return answer_pod(request, Injection())
        found = await self._injection(request, name)
        if found.why_not is not None:
            try:
                async with asyncio.timeout(LOOKUP_TIMEOUT):
                    await self._look_up(DETECTORS, request.namespace, f"metadata.name={name}")
            except (ApiError, Unreachable, TimeoutError) as error:
                log.warning("cannot look up Detector %s/%s, which a pod requests: %s", request.namespace, name, error)
            found = await self._injection(request, name)
        self.measures.reviewed("Pod", "allowed" if found.why_not is None else "warned")
        return answer_pod(request, found)

    async def _injection(self, request: PodRequest, name: str) -> Injection:
        detector = self.cache.detector((request.namespace, name))
        metadata, spec = request.pod["metadata"], request.pod["spec"]
        # In a thread: it compiles the expressions to find out whether the Detector is accepted.
        return await asyncio.to_thread(injection, metadata, spec, request.namespace, detector, self.defaults)


def _parsed(raw: Object | None) -> Kind | None:
    """The object as its kind; None if it is not valid."""
    try:
        return parse_object(raw) if raw is not None else None
    except ValueError:
        return None
