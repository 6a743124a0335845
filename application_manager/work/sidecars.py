"""Posts an Event about each pod that requested a sidecar and was created without it.

The API server's review comes before there is a pod, or not at all since no manager is there. So the pods are looked at
afterwards, and have their Event within an hour after they were made.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from application_manager.cache.cluster_cache import DETECTOR, ClusterCache
from application_manager.cache.detector_index import DetectorIndex
from application_manager.core.findings.injections import injection
from application_manager.core.objects.policy import Name
from application_manager.core.objects.sidecars import has_sidecar
from application_manager.work.recorder import EventReason, Recorder
from wayside.api import Detector
from wayside.api.base import Kind, Metadata
from wayside.times import parse_seconds

NEW = 3600.0  # s after its making in which a pod has its Event; as long as Kubernetes keeps Events, so none comes again
_NOBODY = "it was created before its Detector, or while no webhook was available"


@dataclass(frozen=True, slots=True)
class _Posted:
    """The Event of a pod, and the version of its Detector."""

    version: int
    why: str


@dataclass(frozen=True, slots=True)
class SidecarEvents:
    """Posts them, once a pod and cause."""

    cache: ClusterCache
    index: DetectorIndex
    recorder: Recorder
    _posted: dict[Name, dict[str, _Posted]] = field(default_factory=dict)  # by Detector, then the pod's uid

    def report(self, name: Name) -> None:
        """Post Events about the pods that request the Detector of this namespace and name."""
        entry = self.cache.store.get(DETECTOR, name)
        detector = entry.model if entry is not None and isinstance(entry.model, Detector) else None
        version = entry.version if entry is not None else 0
        before, posted, now = self._posted.pop(name, {}), dict[str, _Posted](), time.time()
        for pod in self.index.requesting.get(name, []):
            metadata, spec = pod["metadata"], pod["spec"]
            if has_sidecar(spec) or metadata.get("deletionTimestamp") or not _is_new(metadata, now):
                continue
            uid, last = metadata["uid"], before.get(metadata["uid"])
            if last is not None and last.version == version:
                posted[uid] = last
                continue
            why = injection(metadata, spec, name[0], detector, self.index.defaults).why_not or _NOBODY
            posted[uid] = _Posted(version, why)
            if last is None or last.why != why:
                about = Metadata(name=metadata["name"], namespace=name[0], uid=uid)
                note = f"it runs without a detector: {why}. Recreate the pod once this is corrected"
                regarding = Kind(api_version="v1", kind="Pod", metadata=about)
                self.recorder.event(regarding, EventReason.NOT_INJECTED, note, now, once=True)
        if posted:
            self._posted[name] = posted


def _is_new(metadata: Mapping[str, Any], now: float) -> bool:
    return now - parse_seconds(metadata["creationTimestamp"]) < NEW
