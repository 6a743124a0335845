"""Decides whether to inject the detector that a pod's label names, and builds the AdmissionReview. Pure.

A pod is never refused. If it cannot have its detector, it is created without it. A warning reports the reason to its
creator, and an Event of the pod reports it later.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from application_manager.core.findings.reviews import REVIEW_VERSION, Json, request_in, shortened
from application_manager.core.findings.rulefindings import detector_findings
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.core.objects.sidecars import SIDECAR_LABEL, Addition, SidecarError, addition, patch
from wayside.api import Detector
from wayside.api.pod import DetectorMode

_MIRROR = "kubernetes.io/config.mirror"
_NO_IMAGE = (
    "the manager runs no detectors: start it with --detector-image, and apply the roles that `application-manager "
    "rbac --detectors` prints"
)


@dataclass(frozen=True, slots=True)
class PodRequest:
    """A review of a pod that is to be created; `pod` is empty if there is nothing to do."""

    uid: str
    namespace: str
    pod: Json


@dataclass(frozen=True, slots=True)
class Injection:
    """The result for a pod: the addition, or the reason why there is none.

    Both are None if it has its detector already, or requests none.
    """

    addition: Addition | None = None
    why_not: str | None = None


def detector_of(metadata: Mapping[str, Any] | None) -> str | None:
    """The Detector that a pod, or a pod template, with this metadata requests; None: none."""
    name = ((metadata or {}).get("labels") or {}).get(SIDECAR_LABEL)
    return None if name is None else str(name)


def injection(
    metadata: Mapping[str, Any],
    spec: Mapping[str, Any],
    namespace: str,
    detector: Detector | None,
    defaults: PodDefaults | None,
) -> Injection:
    """The result for a pod, or a pod template, with this metadata and spec.

    `detector`: the requested one of the namespace, None if there is no valid one; `defaults`: None if the manager runs
    no detectors.
    """
    name = detector_of(metadata)
    if name is None:
        return Injection()
    if defaults is None:
        return Injection(why_not=_NO_IMAGE)
    if detector is None:
        missing = f"namespace {namespace} has no valid Detector {name!r}: create or correct it"
        return Injection(why_not=f"label {SIDECAR_LABEL}: {missing}")
    why_not = _why_not(name, metadata, spec, detector)
    if why_not is not None:
        return Injection(why_not=why_not)
    try:
        return Injection(addition(spec, detector, defaults))
    except SidecarError as error:
        return Injection(why_not=str(error))


def _why_not(name: str, metadata: Mapping[str, Any], spec: Mapping[str, Any], detector: Detector) -> str | None:
    if detector.spec.mode is not DetectorMode.SIDECAR:
        mode = f"mode {detector.spec.mode}" if detector.spec.mode else "no mode"
        return f"Detector {name} has {mode}: give it mode Sidecar, or remove the label {SIDECAR_LABEL}"
    account = str(spec.get("serviceAccountName") or spec.get("serviceAccount") or "default")
    names = detector.spec.service_account_names or []
    if account not in names:
        listed = f"only {', '.join(names)}" if names else "none"
        return f"spec.serviceAccountName: serviceAccountNames of Detector {name} has {listed}, not {account}: add it"
    if detector_findings(detector).problems:
        return f"Detector {name} is not accepted: its condition Accepted reports why"
    if _MIRROR in (metadata.get("annotations") or {}):
        return "a static pod has no service account: create the pod through the API server"
    return None


def read_pod(review: Any) -> PodRequest:
    """The review request about a pod. Raises ReviewError."""
    raw = request_in(review)
    pod, kind = raw.get("object"), raw.get("kind")
    made = raw.get("operation") == "CREATE" and not raw.get("subResource")
    ours = isinstance(kind, dict) and (kind.get("group"), kind.get("kind")) == ("", "Pod")
    if not (made and ours and isinstance(pod, dict) and isinstance(pod.get("spec"), dict)):
        pod = {}
    return PodRequest(raw["uid"], str(raw.get("namespace") or ""), pod)


def answer_pod(request: PodRequest, found: Injection) -> Json:
    """The response: always allowed."""
    response: Json = {"uid": request.uid, "allowed": True}
    if found.addition is not None:
        operations = json.dumps(patch(request.pod["spec"], found.addition)).encode()
        response |= {"patchType": "JSONPatch", "patch": base64.b64encode(operations).decode()}
    if found.why_not is not None:
        response["warnings"] = shortened((f"created without a detector: {found.why_not}",))
    return {"apiVersion": REVIEW_VERSION, "kind": "AdmissionReview", "response": response}
