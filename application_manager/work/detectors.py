"""Reconciling the detectors that the manager runs: their objects are as their Detectors say, or are gone.

What is not the Detector's own is left alone: an object of the same name that it does not control. What it owns goes
with it, by Kubernetes' garbage collection, and without its mode by us.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

from application_manager.cache.cluster_cache import DETECTOR, ClusterCache
from application_manager.cache.detector_index import DetectorIndex
from application_manager.cluster.client import ApiError, Client, Object, Resource
from application_manager.core.conditions import Aspect
from application_manager.core.findings.rulefindings import detector_findings
from application_manager.core.health.refusals import reason_of, with_remedy
from application_manager.core.objects.detectors import KINDS, Manifest, detector_objects
from application_manager.core.objects.ownership import controller_uid, our_fields
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.core.objects.policy import Name
from application_manager.core.objects.sidecars import has_sidecar
from application_manager.core.statuses.running import NOT_ACCEPTED, NOT_RUN, RUNNING, carried, running
from application_manager.work.sidecars import SidecarNews
from wayside.api import Detector
from wayside.api.pod import DetectorMode

_RESOURCES = {each[1]: Resource(*each) for each in KINDS}

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DetectorWork:
    """Makes, changes and removes a detector's objects.

    Attributes:
        judge: asks for the Detector's status to be written.
        sidecars: tells of pods that were to have a detector and have none.
    """

    cache: ClusterCache
    client: Client
    book: DetectorIndex
    judge: Callable[[Name], None]
    sidecars: SidecarNews
    _applied: dict[str, tuple[str, str]] = field(default_factory=dict)  # uid → what was applied, and our fields since

    async def reconcile(self, name: Name) -> None:
        """Make the Detector's objects as it says, and note whether it runs.

        Raises ApiError or Unreachable for what may pass; the caller tries again.
        """
        entry = self.cache.store.get(DETECTOR, name)
        self.sidecars.tell(name)
        if entry is None:
            self.book.said.pop(name, None)
            return
        if not isinstance(entry.model, Detector) or entry.raw["metadata"].get("deletionTimestamp"):
            return  # what is there stays, until the Detector can be read again or is gone
        detector = entry.model
        if detector.spec.mode is None:
            said = None
            await self._remove(name, entry.uid, self.book.owned(entry.uid))
        else:
            said = await self._make(name, detector)
        if self.book.said.get(name) == said:
            return
        if said is None:
            del self.book.said[name]
        else:
            self.book.said[name] = said
        self.judge(name)

    async def _make(self, name: Name, detector: Detector) -> Aspect:
        if self.book.defaults is None:
            return NOT_RUN
        if detector.spec.mode is DetectorMode.SIDECAR:
            return await self._make_rights(name, detector, self.book.defaults)
        there = self.book.owned(detector.metadata.uid).get("Deployment")
        if detector_findings(detector).problems:
            return NOT_ACCEPTED if there is None else running(there, self.book.troubles(name))
        for manifest in detector_objects(detector, self.book.defaults):
            problem = await self._apply(name, detector, manifest)
            if problem is not None:
                return problem
        return running(self.book.owned(detector.metadata.uid).get("Deployment"), self.book.troubles(name))

    async def _make_rights(self, name: Name, detector: Detector, defaults: PodDefaults) -> Aspect:
        """Give the accounts of others' pods what the detector needs in them; by the webhook it comes into them.

        Also where the Detector is not accepted: an account that it names no more has no rights any more.
        """
        manifests = detector_objects(detector, defaults)
        kinds = {each["kind"] for each in manifests}
        await self._remove(name, detector.metadata.uid, set(self.book.owned(detector.metadata.uid)) - kinds)
        for manifest in manifests:
            problem = await self._apply(name, detector, manifest)
            if problem is not None:
                return problem
        asking = self.book.asking.get(name, [])
        if detector_findings(detector).problems and not any(has_sidecar(each["spec"]) for each in asking):
            return NOT_ACCEPTED
        return carried(detector, asking)

    async def _apply(self, name: Name, detector: Detector, manifest: Manifest) -> Aspect | None:
        """Make one object as the manifest says; what keeps it from being so, if anything."""
        kind, called = manifest["kind"], manifest["metadata"]["name"]
        what = f"{kind} {called}"
        known = self.book.owned(detector.metadata.uid)
        live = known.get(kind) or await self.client.get(_RESOURCES[kind], name[0], called)
        digest = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
        if live is not None:
            problem = _foreign(live, detector, what)
            if problem is not None:
                return problem
            known[kind] = live
            uid = live["metadata"]["uid"]
            if self._applied.get(uid) == (digest, our_fields(live)):
                return None
            manifest = manifest | {"metadata": manifest["metadata"] | {"uid": uid}}
        try:
            raw = await self.client.apply(_RESOURCES[kind], manifest)
        except ApiError as error:
            if error.code == 409:  # vanished or replaced since we looked
                known.pop(kind, None)
                return Aspect(RUNNING, False, "Waiting", f"{what} changed hands while it was applied; looking again")
            if error.terminating:
                return Aspect(RUNNING, False, "Waiting", "the namespace is being deleted")
            if not error.permanent:
                raise
            reason = reason_of(error.code, error.message)
            return Aspect(RUNNING, False, reason, with_remedy(reason, f"{what}: {error.message}"))
        if live is None:
            log.info("detector %s/%s: made %s", *name, what)
        known[kind] = raw
        self._applied[raw["metadata"]["uid"]] = digest, our_fields(raw)
        return None

    async def _remove(self, name: Name, uid: str, kinds: Iterable[str]) -> None:
        """Remove what the Detector controls of these kinds: with its mode as it is they are not needed."""
        for kind in list(kinds):
            raw = self.book.owned(uid)[kind]
            await self.client.delete(_RESOURCES[kind], name[0], raw["metadata"]["name"], raw["metadata"]["uid"])
            self.book.owned(uid).pop(kind, None)
            self._applied.pop(raw["metadata"]["uid"], None)
            log.info("detector %s/%s: removed %s %s", *name, kind, raw["metadata"]["name"])


def _foreign(live: Object, detector: Detector, what: str) -> Aspect | None:
    """Why the object may not be applied over, or None if it is the Detector's own."""
    waiting = Aspect(RUNNING, False, "Waiting", "")
    if live["metadata"].get("deletionTimestamp"):
        return replace(waiting, message=f"{what} is being deleted; it is made again once it is gone")
    if controller_uid(live) == detector.metadata.uid:
        return None
    owners = live["metadata"].get("ownerReferences") or []
    if any((each["kind"], each["name"]) == ("Detector", detector.name) for each in owners):
        return replace(waiting, message=f"{what} of the previous Detector of this name is still being removed")
    return Aspect(
        RUNNING,
        False,
        "ObjectExists",
        f"{what} exists already, is not this Detector's and is left alone: delete or rename it, or rename the Detector",
    )
