"""Telling, by an Event, of each pod that was to have a detector as a sidecar and was made without.

The API server asks before there is a pod of which an Event could speak, or does not ask since no manager is there. So
the pods are looked at afterwards, and told of within an hour after they were made.
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
from application_manager.work.recorder import Reason, Recorder
from wayside.api import Detector
from wayside.api.base import Kind, Metadata
from wayside.times import parse_seconds

NEW = 3600.0  # s after its making in which a pod is told of; as long as Kubernetes keeps Events, so none comes again
_NOBODY = "it was made before its Detector, or while no manager answered the API server"


@dataclass(frozen=True, slots=True)
class _Told:
    """What was said of a pod, by which version of its Detector."""

    version: int
    why: str


@dataclass(frozen=True, slots=True)
class SidecarNews:
    """Tells it, once a pod and cause."""

    cache: ClusterCache
    book: DetectorIndex
    recorder: Recorder
    _told: dict[Name, dict[str, _Told]] = field(default_factory=dict)  # by Detector, then the pod's uid

    def tell(self, name: Name) -> None:
        """Tell of the pods that ask for the Detector of this namespace and name."""
        entry = self.cache.store.get(DETECTOR, name)
        detector = entry.model if entry is not None and isinstance(entry.model, Detector) else None
        version = entry.version if entry is not None else 0
        before, told, now = self._told.pop(name, {}), dict[str, _Told](), time.time()
        for pod in self.book.asking.get(name, []):
            metadata, spec = pod["metadata"], pod["spec"]
            if has_sidecar(spec) or metadata.get("deletionTimestamp") or not _is_new(metadata, now):
                continue
            uid, last = metadata["uid"], before.get(metadata["uid"])
            if last is not None and last.version == version:
                told[uid] = last
                continue
            why = injection(metadata, spec, name[0], detector, self.book.defaults).why_not or _NOBODY
            told[uid] = _Told(version, why)
            if last is None or last.why != why:
                about = Metadata(name=metadata["name"], namespace=name[0], uid=uid)
                note = f"it runs without a detector: {why}. A pod that is made anew has one once that is put right"
                regarding = Kind(api_version="v1", kind="Pod", metadata=about)
                self.recorder.say(regarding, Reason.NOT_INJECTED, note, now, once=True)
        if told:
            self._told[name] = told


def _is_new(metadata: Mapping[str, Any], now: float) -> bool:
    return now - parse_seconds(metadata["creationTimestamp"]) < NEW
