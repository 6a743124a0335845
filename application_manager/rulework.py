"""Reconciling EventRules and Detectors: their statuses. They run in detectors; here they are only judged."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from application_manager.client import ApiError, Client, Object, Resource
from application_manager.core.policy import KindKey
from application_manager.core.rulestatus import detector_status, rule_status
from application_manager.core.status import difference
from application_manager.recorder import Recorder
from application_manager.store import Name
from application_manager.world import DETECTOR, EVENT_RULE, World
from wayside.api import Detector, EventRule
from wayside.api.detector import DetectorStatus
from wayside.api.eventrule import EventRuleStatus

RuleKey = tuple[KindKey, Name]
"""An EventRule or a Detector."""


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
        judged, now = entry.model, time.time()
        old: EventRuleStatus | DetectorStatus
        new: EventRuleStatus | DetectorStatus
        if isinstance(judged, EventRule):
            old = judged.status or EventRuleStatus()
            new = rule_status(judged, self.world.models(DETECTOR, Detector, name[0]), now)
        elif isinstance(judged, Detector):
            old = judged.status or DetectorStatus()
            new = detector_status(judged, self.world.models(EVENT_RULE, EventRule, name[0]), now)
        else:
            return  # passed the API server and is no model: the detector says so in its log
        patch = difference(old.to_json() if judged.status else {}, new.to_json())
        if not patch:
            return
        try:
            uid = judged.metadata.uid
            self.observe(await self.client.patch_status(self.resources[kind], name[0], name[1], uid, patch))
        except ApiError as error:
            if error.terminating or error.code == 404:
                return
            raise
        self.recorder.transitions(judged, old.conditions, new.conditions, now)
