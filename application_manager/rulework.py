"""Reconciling EventRules and Detectors: their statuses. They run in detectors; here they are only judged."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from application_manager.client import ApiError, Client, Object, Resource
from application_manager.core.policy import KindKey
from application_manager.core.rulestatus import detector_status, rule_status, unreadable_status
from application_manager.core.status import difference
from application_manager.recorder import Recorder
from application_manager.store import Entry, Name
from application_manager.world import DETECTOR, EVENT_RULE, World
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
    """

    world: World
    client: Client
    recorder: Recorder
    resources: dict[KindKey, Resource]
    observe: Callable[[Object], None]

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
        old, new = self._judged(kind, name[0], entry, now)
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

    def _judged(self, kind: KindKey, namespace: str, entry: Entry, now: float) -> tuple[Status, Status]:
        """The status as it is and as it should be."""
        written = entry.raw.get("status") or {}
        generation = int(entry.raw["metadata"].get("generation", 0))
        old: Status
        if kind == EVENT_RULE:
            old, judged = EventRuleStatus.model_validate(written), entry.model
            if not isinstance(judged, EventRule):
                return old, unreadable_status(old, "RuleInvalid", entry.problem, generation, now)
            detectors = self.world.models(DETECTOR, Detector, namespace)
            others = self.world.models(EVENT_RULE, EventRule, namespace) if depends(judged) else []
            return old, rule_status(judged, detectors, now, self.world.invalid(DETECTOR, namespace), others)
        old, judged = DetectorStatus.model_validate(written), entry.model
        if not isinstance(judged, Detector):
            return old, unreadable_status(old, "DetectorInvalid", entry.problem, generation, now)
        return old, detector_status(judged, self.world.models(EVENT_RULE, EventRule, namespace), now)
