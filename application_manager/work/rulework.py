"""Reconciles EventRules and Detectors: checks them and writes their statuses."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import partial

from application_manager.cache.cluster_cache import EVENT_RULE, OWN, ClusterCache, surroundings
from application_manager.cache.detector_index import DetectorIndex
from application_manager.cache.store import Entry
from application_manager.core.objects.policy import KindKey, Name
from application_manager.core.statuses.rulestatus import (
    DETECTOR_INVALID,
    RULE_INVALID,
    detector_status,
    unreadable_status,
)
from application_manager.work.statuses import StatusWriter
from application_manager.workers.pool import ExceededError, Runs
from wayside.api import Detector, EventRule
from wayside.api.base import Kind, Metadata
from wayside.api.detector import DetectorStatus
from wayside.api.eventrule import EventRuleStatus

RuleKey = tuple[KindKey, Name]
"""An EventRule or a Detector."""

Status = EventRuleStatus | DetectorStatus


@dataclass(frozen=True, slots=True)
class RuleWork:
    """Writes the statuses of rules and detectors."""

    cache: ClusterCache
    statuses: StatusWriter
    pool: Runs
    detectors: DetectorIndex = field(default_factory=DetectorIndex)

    async def reconcile(self, key: RuleKey) -> None:
        """Write the status of the rule or detector if it differs.

        Raises ApiError or Unreachable for what may pass; the caller tries again.
        """
        kind, name = key
        entry = self.cache.store.get(kind, name)
        if entry is None:
            return
        now = time.time()
        metadata = Metadata.model_validate(entry.raw["metadata"])
        old, new = await self._judged(kind, name, entry, now)
        regarding = Kind(kind=OWN[kind].kind, metadata=metadata)
        await self.statuses.write(OWN[kind], regarding, old if entry.raw.get("status") else None, new, now)

    async def _judged(self, kind: KindKey, name: Name, entry: Entry, now: float) -> tuple[Status, Status]:
        """The status as it is and as it should be."""
        namespace = name[0]
        written = entry.raw.get("status") or {}
        generation = int(entry.raw["metadata"].get("generation", 0))
        old: Status
        if kind == EVENT_RULE:
            old, judged = EventRuleStatus.model_validate(written), entry.model
            if not isinstance(judged, EventRule):
                return old, unreadable_status(old, RULE_INVALID, entry.problem, generation, now)
            job = partial(surroundings(self.cache, judged).status, judged, now)
            try:
                return old, await self.pool.run(namespace, job)
            except ExceededError as error:
                return old, unreadable_status(old, RULE_INVALID, f"spec: compiling the rule {error}", generation, now)
        old, judged = DetectorStatus.model_validate(written), entry.model
        if not isinstance(judged, Detector):
            return old, unreadable_status(old, DETECTOR_INVALID, entry.problem, generation, now)
        rules, running = self.cache.models(EVENT_RULE, EventRule, namespace), self.detectors.running.get(name)
        try:
            return old, await self.pool.run(namespace, partial(detector_status, judged, rules, now, running))
        except ExceededError as error:
            problem = f"spec: compiling the detector {error}"
            return old, unreadable_status(old, DETECTOR_INVALID, problem, generation, now)
