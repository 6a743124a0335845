"""Reconciles the detectors that the manager runs: applies their objects, or deletes them.

An object of the same name that the Detector does not control is not changed. When the Detector is deleted, Kubernetes'
garbage collection deletes its objects; when its mode is removed, the manager does.

A pod that requested a sidecar and was created without it has an Event. The review cannot create it, because it comes
before the pod exists, or never if no manager is available. So the pods are checked afterwards, within an hour after
their creation.
"""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from application_manager.cache.cluster_cache import DETECTOR, ClusterCache
from application_manager.cache.detector_index import DetectorIndex, ProcessedState
from application_manager.core.conditions import ConditionState
from application_manager.core.findings.injections import injection
from application_manager.core.findings.rulefindings import detector_findings
from application_manager.core.objects.detectors import KINDS, Manifest, detector_objects
from application_manager.core.objects.ownership import ApplyProblem, controller_uid, our_fields
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.core.objects.policy import Name
from application_manager.core.objects.sidecars import has_sidecar
from application_manager.core.statuses.rulestatus import NOT_ACCEPTED, NOT_RUN, RUNNING, running, running_in_pods
from application_manager.work.applying import apply_owned
from application_manager.work.recorder import EventReason, Recorder
from wayside.api import Detector
from wayside.api.base import Kind, Metadata
from wayside.api.pod import DetectorMode
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Resource
from wayside.times import parse_seconds

_RESOURCES = {each[1]: Resource(*each) for each in KINDS}

NEW = 3600.0  # s after the creation of a pod in which its Event is posted; Kubernetes keeps Events for the same time
_NOBODY = "it was created before its Detector, or while no webhook was available"

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Posted:
    """The Event of a pod, and the version of its Detector."""

    version: int
    why: str


@dataclass(frozen=True, slots=True)
class DetectorWork:
    """Creates, changes and deletes a detector's objects; `validate` enqueues the Detector's status."""

    cache: ClusterCache
    client: Client
    index: DetectorIndex
    validate: Callable[[Name], None]
    recorder: Recorder
    _posted: dict[Name, dict[str, _Posted]] = field(default_factory=dict)  # by Detector, then the pod's uid
    _applied: dict[str, tuple[str, str]] = field(default_factory=dict)  # uid → the last apply, our fields

    async def reconcile(self, name: Name) -> None:
        """Apply the Detector's objects, and note whether it runs. Raises RequestError for a temporary error."""
        entry = self.cache.store.get(DETECTOR, name)
        self._report(name)
        if entry is None:
            self.index.processed.pop(name, None)
            return
        if not isinstance(entry.model, Detector) or entry.raw["metadata"].get("deletionTimestamp"):
            return  # the objects stay until the Detector can be read again or is deleted
        detector = entry.model
        if detector.spec.mode is None:
            await self._remove(name, entry.uid, self.index.owned(entry.uid))
            self.index.processed.pop(name, None)
            return
        running = await self._ensure(name, detector)
        processed = ProcessedState(entry.uid, detector.metadata.generation, running)
        if self.index.processed.get(name) != processed:
            self.index.processed[name] = processed
            self.validate(name)

    async def _ensure(self, name: Name, detector: Detector) -> ConditionState:
        if self.index.defaults is None:
            return NOT_RUN
        if detector.spec.mode is DetectorMode.SIDECAR:
            return await self._ensure_rights(name, detector, self.index.defaults)
        there = self.index.owned(detector.metadata.uid).get("Deployment")
        if detector_findings(detector).problems:
            return NOT_ACCEPTED if there is None else running(there, self.index.troubles(name))
        if (problem := await self._apply(name, detector, detector_objects(detector, self.index.defaults))) is not None:
            return problem
        return running(self.index.owned(detector.metadata.uid).get("Deployment"), self.index.troubles(name))

    async def _ensure_rights(self, name: Name, detector: Detector, defaults: PodDefaults) -> ConditionState:
        """Give the service accounts of other pods the permissions of the detector that the webhook injects into them.

        This applies even if the Detector is not accepted: a service account that it no longer lists loses them.
        """
        manifests = detector_objects(detector, defaults)
        kinds = {each["kind"] for each in manifests}
        await self._remove(name, detector.metadata.uid, set(self.index.owned(detector.metadata.uid)) - kinds)
        if (problem := await self._apply(name, detector, manifests)) is not None:
            return problem
        requesting = self.index.requesting.get(name, [])
        if detector_findings(detector).problems and not any(has_sidecar(each["spec"]) for each in requesting):
            return NOT_ACCEPTED
        return running_in_pods(detector, requesting)

    async def _apply(self, name: Name, detector: Detector, manifests: Iterable[Manifest]) -> ConditionState | None:
        """Apply the objects, up to the first that fails; returns its problem, if any."""
        for manifest in manifests:
            problem = await self._apply_one(name, detector, manifest)
            if problem is not None:
                return problem
        return None

    async def _apply_one(self, name: Name, detector: Detector, manifest: Manifest) -> ConditionState | None:
        kind, called = manifest["kind"], manifest["metadata"]["name"]
        uid = detector.metadata.uid
        live = self.index.owned(uid).get(kind) or await self.client.get(_RESOURCES[kind], name[0], called)
        digest = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
        if live is not None and controller_uid(live) == uid:
            self.index.objects.put(uid, kind, live)
            as_applied = self._applied.get(live["metadata"]["uid"]) == (digest, our_fields(live))
            if as_applied and not live["metadata"].get("deletionTimestamp"):
                return None
        try:
            raw = await apply_owned(self.client, _RESOURCES[kind], manifest, detector, live)
        except ApiError as error:
            if not error.terminating:
                raise
            return ConditionState(RUNNING, False, "Waiting", "the namespace is being deleted")
        if isinstance(raw, ApplyProblem):
            if raw.reason == "Waiting":
                self.index.objects.drop(uid, kind)  # to be read again
            return ConditionState(RUNNING, False, raw.reason, raw.message)
        if live is None:
            log.info("detector %s/%s: created %s %s", *name, kind, called)
        self.index.objects.put(uid, kind, raw)
        self._applied[raw["metadata"]["uid"]] = digest, our_fields(raw)
        return None

    async def _remove(self, name: Name, uid: str, kinds: Iterable[str]) -> None:
        """Delete the objects of these kinds that the Detector controls: its mode does not need them."""
        for kind in list(kinds):
            raw = self.index.owned(uid).get(kind)
            if raw is None:
                continue  # it disappeared while another one was deleted
            await self.client.delete(_RESOURCES[kind], name[0], raw["metadata"]["name"], raw["metadata"]["uid"])
            self.index.objects.drop(uid, kind)
            self._applied.pop(raw["metadata"]["uid"], None)
            log.info("detector %s/%s: removed %s %s", *name, kind, raw["metadata"]["name"])

    def _report(self, name: Name) -> None:
        """Post Events about the pods that request the Detector and run without it, once for each pod and cause."""
        entry, detector = self.cache.store.get(DETECTOR, name), self.cache.detector(name)
        version = entry.version if entry is not None else 0
        before, posted, now = self._posted.pop(name, {}), dict[str, _Posted](), time.time()
        for pod in self.index.requesting.get(name, []):
            metadata, spec = pod["metadata"], pod["spec"]
            age = now - parse_seconds(metadata["creationTimestamp"])
            if has_sidecar(spec) or metadata.get("deletionTimestamp") or age >= NEW:
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
