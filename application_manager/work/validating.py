"""Reconciles EventRules, Detectors and templates: checks them in worker processes, and writes their statuses."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

from application_manager.cache.cluster_cache import EVENT_RULE, OWN, TEMPLATE, TEMPLATES, ClusterCache, rule_context
from application_manager.cache.detector_index import DetectorIndex
from application_manager.cache.overlap_index import NamespaceRole
from application_manager.cache.store import Entry
from application_manager.core.claims.claims import InvalidTemplate
from application_manager.core.findings.findings import Findings
from application_manager.core.findings.templatefindings import template_findings
from application_manager.core.objects.policy import KindKey, Name
from application_manager.core.statuses.rulestatus import (
    DETECTOR_INVALID,
    RULE_INVALID,
    Status,
    detector_status,
    rule_status,
    unreadable_status,
)
from application_manager.core.statuses.status import template_status
from application_manager.work.recorder import EventReason
from application_manager.work.statuses import StatusWriter
from application_manager.workers.pool import ExceededError, Runs
from application_manager.workers.process import Job
from wayside.api import Detector, EventRule
from wayside.api.applicationtemplate import ApplicationTemplateStatus, TemplateManager
from wayside.api.base import Kind, Metadata
from wayside.api.detector import DetectorStatus
from wayside.api.eventrule import EventRuleStatus

RuleKey = tuple[KindKey, Name]
"""An EventRule or a Detector."""


@dataclass(frozen=True, slots=True)
class RuleWork:
    """Writes the statuses of rules and detectors."""

    cache: ClusterCache
    statuses: StatusWriter
    pool: Runs
    detectors: DetectorIndex = field(default_factory=DetectorIndex)

    async def reconcile(self, key: RuleKey) -> None:
        """Write the status of the rule or detector if it differs. Raises RequestError for a temporary error."""
        kind, name = key
        entry = self.cache.store.get(kind, name)
        if entry is None:
            return
        now = time.time()
        old, new = await self._statuses(kind, name, entry, now)
        await self.statuses.write(OWN[kind], _bare(entry), old if entry.raw.get("status") else None, new, now)

    async def _statuses(self, kind: KindKey, name: Name, entry: Entry, now: float) -> tuple[Status, Status]:
        """The current status and the new one."""
        namespace = name[0]
        written = entry.raw.get("status") or {}
        generation = int(entry.raw["metadata"].get("generation", 0))
        old: Status
        job: Job[Status] | None = None
        if kind == EVENT_RULE:
            old, reason, what = EventRuleStatus.model_validate(written), RULE_INVALID, "rule"
            if isinstance(entry.model, EventRule):
                job = partial(rule_status, entry.model, rule_context(self.cache, entry.model), now)
        else:
            old, reason, what = DetectorStatus.model_validate(written), DETECTOR_INVALID, "detector"
            if isinstance(entry.model, Detector):
                rules, running = (
                    self.cache.models(EVENT_RULE, EventRule, namespace),
                    self.detectors.running(entry.model),
                )
                job = partial(detector_status, entry.model, rules, now, running)
        problem = entry.problem
        if job is not None:
            try:
                return old, await self.pool.run(namespace, job)
            except ExceededError as error:
                problem = f"spec: compiling the {what} {error}"
        return old, unreadable_status(old, reason, problem, generation, now)


@dataclass(frozen=True, slots=True)
class TemplateWork:
    """Writes the statuses of templates; `enqueue_at` enqueues one at a time, in seconds since 1970."""

    cache: ClusterCache
    statuses: StatusWriter
    pool: Runs
    enqueue_at: Callable[[Name, float], None]

    async def reconcile(self, name: Name) -> None:
        """Write the template's status if it differs. Raises RequestError for a temporary error."""
        entry = self.cache.store.get(TEMPLATE, name)
        if entry is None:
            return
        regarding, now = _bare(entry), time.time()
        old = ApplicationTemplateStatus.model_validate(entry.raw.get("status") or {})
        own = self.cache.overlap.own()
        role, until = self.cache.overlap.role(name, now)
        self.cache.overlap.take(name[0], role, until)
        if role is not NamespaceRole.ACT:
            self.enqueue_at(name, until)
            if role is NamespaceRole.CHALLENGE and own is not None:
                await self._challenge(regarding, own, now)
            return
        findings = await self._findings(name)
        count = len(self.cache.instances_of(name))
        new = template_status(old, regarding.metadata.generation, findings, count, now, own)
        await self.statuses.write(TEMPLATES, regarding, old if entry.raw.get("status") else None, new, now)

    async def _challenge(self, regarding: Kind, own: TemplateManager, now: float) -> None:
        """Test by the template's status whether the other manager of the namespace is alive."""
        other = self.cache.overlap.waits_for(regarding.namespace)
        note = f"the managers of the Leases {other} and {own.lease} manage the same namespace: the second one stands by"
        self.statuses.recorder.event(regarding, EventReason.MANAGERS_OVERLAP, note, now, once=True)
        await self.statuses.merge(TEMPLATES, regarding, {"manager": own.to_json()})

    async def _findings(self, name: Name) -> Findings:
        template = self.cache.template(name)
        if isinstance(template, InvalidTemplate):
            return Findings((template.problem,))
        if template is None:
            return Findings()
        found = self.cache.known_findings(template)
        if found is None:
            try:
                found = await self.pool.run(name[0], partial(template_findings, template, self.cache.policy))
            except ExceededError as error:
                found = Findings((f"spec: rendering the template {error}",))
            self.cache.note_findings(template, found)
        exceeded = self.cache.exceeded.get(name)
        if exceeded:
            instance, why = min(exceeded.items())
            return replace(found, problems=(*found.problems, f"spec: rendering instance {instance[1]} {why}"))
        return found


def _bare(entry: Entry) -> Kind:
    """The object without spec and status, which may be invalid."""
    return Kind(kind=entry.raw["kind"], metadata=Metadata.model_validate(entry.raw["metadata"]))
