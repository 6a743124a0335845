"""Reconciles one template: whether it can be rendered, and the number of its instances."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from application_manager.cache.cluster_cache import TEMPLATE, TEMPLATES, ClusterCache
from application_manager.cache.overlap_index import Turn
from application_manager.core.claims.claims import InvalidTemplate
from application_manager.core.findings.findings import Findings
from application_manager.core.findings.templatefindings import template_findings
from application_manager.core.objects.policy import Name
from application_manager.core.statuses.status import template_status
from application_manager.work.recorder import EventReason
from application_manager.work.statuses import StatusWriter
from application_manager.workers.pool import ExceededError, Runs
from wayside.api.applicationtemplate import ApplicationTemplateStatus, TemplateManager
from wayside.api.base import Kind, Metadata


@dataclass(frozen=True, slots=True)
class TemplateWork:
    """Writes the statuses of templates; `again` enqueues one at a time, in seconds since 1970."""

    cache: ClusterCache
    statuses: StatusWriter
    pool: Runs
    again: Callable[[Name, float], None]

    async def reconcile(self, name: Name) -> None:
        """Write the template's status if it differs.

        Raises ApiError or Unreachable for what may pass; the caller tries again.
        """
        entry = self.cache.store.get(TEMPLATE, name)
        if entry is None:
            return
        metadata = Metadata.model_validate(entry.raw["metadata"])
        regarding = Kind(kind=TEMPLATES.kind, metadata=metadata)
        now = time.time()
        old = ApplicationTemplateStatus.model_validate(entry.raw.get("status") or {})
        own = self.cache.overlap.own()
        turn, when = self.cache.overlap.turn(name, now)
        if turn is not Turn.ACT:
            self.again(name, when)
            if turn is Turn.CHALLENGE and own is not None:
                await self._challenge(regarding, own, now)
            return
        findings = await self._findings(name)
        new = template_status(old, metadata.generation, findings, len(self.cache.instances_of(name)), now, own)
        await self.statuses.write(TEMPLATES, regarding, old if entry.raw.get("status") else None, new, now)

    async def _challenge(self, regarding: Kind, own: TemplateManager, now: float) -> None:
        """Find out by the template's status whether the other manager of the namespace is alive."""
        other = self.cache.overlap.waits_for(regarding.namespace)
        note = (
            f"this namespace is managed by the managers of the Leases {other} and {own.lease}: the second one stands by"
        )
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
