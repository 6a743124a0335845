"""Whether a detector that the manager runs does run, and if not, why. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from application_manager.core.conditions import Aspect
from application_manager.core.health.pods import Trouble, summary, trouble
from application_manager.core.health.readiness import not_ready
from application_manager.core.objects.sidecars import sidecar_pods
from wayside.api import Detector

RUNNING = "Running"
"""The condition's type."""

NOT_RUN = Aspect(
    RUNNING,
    False,
    "NotRun",
    "the manager runs no detectors: start it with --detector-image, and with the permissions that "
    "`application-manager rbac --detectors` prints; or remove spec.mode and run the detector yourself",
)
"""The condition where the manager has no image."""

NOT_ACCEPTED = Aspect(RUNNING, False, "NotAccepted", "no objects are created for a Detector that is not accepted")
"""The condition of a Detector that cannot run and was never made."""


def carried(detector: Detector, pods: Sequence[Mapping[str, Any]]) -> Aspect:
    """The condition Running of a sidecar, by the pods that request it; pods that have ended do not count."""
    if not detector.spec.service_account_names:
        return Aspect(
            RUNNING, False, "NoAccounts", "spec.serviceAccountNames: is empty: list the service accounts of its pods"
        )
    pods = [each for each in pods if not _is_over(each)]
    sidecars = list(sidecar_pods(pods))
    troubles = summary(found for each in sidecars if (found := trouble(each)) is not None)
    of = f"of {len(pods)} pods with its label"
    running = sum(1 for each in sidecars if _runs(each))
    if troubles:
        return Aspect(RUNNING, False, troubles[0].reason.value, f"it runs in {running} {of}: {troubles[0].text}")
    missing = len(pods) - len(sidecars)
    but = f"; {missing} were created without it: their Events give the reason" if missing else ""
    return Aspect(RUNNING, True, "InPods", f"it runs in {running} {of}{but}")


def _is_over(pod: Mapping[str, Any]) -> bool:
    """Whether the pod has ended or is about to: a Job's, whose own containers have, and whose sidecars are about to."""
    status, spec = pod.get("status") or {}, pod.get("spec") or {}
    if pod["metadata"].get("deletionTimestamp") or status.get("phase") in ("Succeeded", "Failed"):
        return True
    own = [each.get("state") or {} for each in status.get("containerStatuses") or ()]
    return bool(own) and spec.get("restartPolicy") != "Always" and all("terminated" in each for each in own)


def _runs(pod: Mapping[str, Any]) -> bool:
    return any("running" in (each.get("state") or {}) for each in pod["status"]["initContainerStatuses"])


def running(deployment: Mapping[str, Any] | None, troubles: Sequence[Trouble]) -> Aspect:
    """The condition Running, by the Deployment as it is and what keeps its pods from running."""
    if deployment is None:
        return Aspect(RUNNING, False, "NotReady", "its Deployment does not exist yet")
    what = f"Deployment {deployment['metadata']['name']}"
    problem = not_ready(deployment)
    if problem is None:
        return Aspect(RUNNING, True, "Running", f"{what} runs it")
    if troubles:
        return Aspect(RUNNING, False, troubles[0].reason.value, f"{what} {problem}: {troubles[0].text}")
    return Aspect(RUNNING, False, "NotReady", f"{what} {problem}")
