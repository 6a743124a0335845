"""Reconciling EventRules and Detectors: their statuses. They run in detectors; here they are only judged."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from application_manager.cluster.client import ApiError, Client, Object, Resource
from application_manager.cluster.store import Entry, Name
from application_manager.core.objects.policy import KindKey
from application_manager.core.statuses.rulestatus import (
    DETECTOR_INVALID,
    RULE_INVALID,
    detector_status,
    rule_status,
    unreadable_status,
)
from application_manager.core.statuses.status import difference
from application_manager.knowledge.detectorbook import DetectorBook
from application_manager.knowledge.world import DETECTOR, EVENT_RULE, World
from application_manager.work.recorder import Recorder
from wayside.api import Detector, EventRule
from wayside.api.base import Kind, Metadata
from wayside.api.detector import DetectorStatus
from wayside.api.eventrule import EventRuleStatus
from wayside.rules import depends

RuleKey = tuple[KindKey, Name]
"""An EventRule or a Detector."""

Status = EventRuleStatus | DetectorStatus


@dataclass(frozen=True, slots=True)
class RuleWork:
    """Says how rules and detectors are.

    Attributes:
        resources: where EventRules and Detectors live.
        observe: takes an object that was read.
        detectors: what is known of those that the manager runs.
    """

    world: World
    client: Client
    recorder: Recorder
    resources: dict[KindKey, Resource]
    observe: Callable[[Object], None]
    detectors: DetectorBook = field(default_factory=DetectorBook)

    async def reconcile(self, key: RuleKey) -> None:
        """Write the status of the rule or detector if it is news.

        Raises ApiError or Unreachable for what may pass; the caller tries again.
        """
        kind, name = key
        entry = self.world.store.get(kind, name)
        if entry is None:
            return
        now = time.time()
        metadata = Metadata.model_validate(entry.raw["metadata"])
        written = entry.raw.get("status")
        old, new = await self._judged(kind, name, entry, now)
        patch = difference(old.to_json() if written else {}, new.to_json())
        if not patch:
            return
        try:
            self.observe(await self.client.patch_status(self.resources[kind], name[0], name[1], metadata.uid, patch))
        except ApiError as error:
            if error.terminating or error.code == 404:
                return
            raise
        about = Kind(kind=self.resources[kind].kind, metadata=metadata)
        self.recorder.transitions(about, old.conditions, new.conditions, now)

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
            detectors = self.world.models(DETECTOR, Detector, namespace)
            others = self.world.models(EVENT_RULE, EventRule, namespace) if depends(judged) else []
            invalid, remarks = self.world.invalid(DETECTOR, namespace), self.world.deploy_remarks(judged)
            # Beside the event loop: with many detectors it may take seconds.
            return old, await asyncio.to_thread(rule_status, judged, detectors, now, invalid, others, remarks)
        old, judged = DetectorStatus.model_validate(written), entry.model
        if not isinstance(judged, Detector):
            return old, unreadable_status(old, DETECTOR_INVALID, entry.problem, generation, now)
        running = self.detectors.said.get(name)
        return old, detector_status(judged, self.world.models(EVENT_RULE, EventRule, namespace), now, running)
