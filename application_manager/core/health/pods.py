"""Why a pod does not run, from its status. Pure.

The same trouble gives the same text, whatever the kubelet's current attempt is: pulling an image again, or running a
crashing container for a moment. So a status with this text is not rewritten at each attempt.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from application_manager.core.conditions import cut, find_raw

_LONGEST = 600  # characters of a kubelet's or scheduler's message

_IMAGE = frozenset(
    {
        "ErrImagePull",
        "ImagePullBackOff",
        "ErrImageNeverPull",
        "InvalidImageName",
        "ImageInspectError",
        "RegistryUnavailable",
        "SignatureValidationFailed",
    }
)
"""Waiting reasons of a container that concern its image, from the kubelet's `pkg/kubelet/images/types.go`."""

_CREATION = frozenset(
    {
        "CreateContainerConfigError",
        "CreateContainerError",
        "RunContainerError",
        "PreCreateHookError",
        "PostStartHookError",
    }
)


class TroubleReason(StrEnum):
    """The kind of a trouble: reasons of the condition Ready, the most specific first."""

    IMAGE_PULL_FAILED = "ImagePullFailed"
    CONTAINER_FAILED = "ContainerFailed"
    CRASH_LOOP = "CrashLoop"
    POD_FAILED = "PodFailed"
    UNSCHEDULABLE = "Unschedulable"
    QUOTA_EXCEEDED = "QuotaExceeded"
    ADMISSION_REFUSED = "AdmissionRefused"


@dataclass(frozen=True, slots=True)
class Trouble:
    """Why a pod does not run.

    Attributes:
        message: names the image or container, and the cause; equal for all pods with the same trouble.
        hint: the command that shows more, with the name of the pod; empty if the message is complete.
    """

    reason: TroubleReason
    message: str
    hint: str = ""

    @property
    def text(self) -> str:
        """The message with the hint."""
        return f"{self.message} ({self.hint})" if self.hint else self.message


def trouble(pod: Mapping[str, Any]) -> Trouble | None:
    """Why the pod does not run; None if it runs, or the cause is not known yet, or it is being deleted."""
    status = pod.get("status") or {}
    if pod["metadata"].get("deletionTimestamp") or status.get("phase") == "Succeeded":
        return None
    spec = pod.get("spec") or {}
    containers = [*(spec.get("initContainers") or ()), *(spec.get("containers") or ())]
    images = {str(each.get("name")): str(each.get("image", "")) for each in containers}
    for field in ("initContainerStatuses", "containerStatuses"):
        for container in status.get(field) or ():
            found = _of_container(container, images, pod, init=field == "initContainerStatuses")
            if found is not None:
                return found
    if status.get("phase") == "Failed":
        why = status.get("message") or status.get("reason") or "no reason given"
        return Trouble(TroubleReason.POD_FAILED, f"a pod failed: {_plain(why)}")
    scheduled = find_raw(status, "PodScheduled")
    if scheduled.get("status") == "False":
        why = scheduled.get("message") or scheduled.get("reason") or "no reason given"
        return Trouble(TroubleReason.UNSCHEDULABLE, f"no node fits the pod: {_plain(why)}")
    return None


def summary(troubles: Iterable[Trouble]) -> list[Trouble]:
    """Each distinct trouble once, the most specific first."""
    order = list(TroubleReason)
    different: dict[tuple[TroubleReason, str], Trouble] = {}
    for each in sorted(troubles, key=lambda each: (order.index(each.reason), each.message, each.hint)):
        different.setdefault((each.reason, each.message), each)
    return list(different.values())


def _of_container(
    container: Mapping[str, Any], images: Mapping[str, str], pod: Mapping[str, Any], *, init: bool
) -> Trouble | None:
    name = str(container.get("name"))
    what = f"init container {name}" if init else f"container {name}"
    state = container.get("state") or {}
    waiting = state.get("waiting") or {}
    reason = waiting.get("reason")
    if reason in _IMAGE:
        image = images.get(name) or container.get("image", "")
        cause = _pull_cause(waiting.get("message") or "") or reason
        return Trouble(TroubleReason.IMAGE_PULL_FAILED, f"cannot pull image {image}: {cause}")
    if reason in _CREATION:
        cause = _plain(waiting.get("message") or reason)
        return Trouble(TroubleReason.CONTAINER_FAILED, f"cannot start {what}: {cause}")
    ended = state.get("terminated") or (container.get("lastState") or {}).get("terminated") or {}
    if not ended.get("exitCode") or container.get("ready"):
        return None
    namespace, pod_name = pod["metadata"].get("namespace", "default"), pod["metadata"]["name"]
    once = (pod.get("spec") or {}).get("restartPolicy") == "Never"
    verb = "failed" if once else "crashes"
    log = f"kubectl logs -n {namespace} {pod_name} -c {name}" + ("" if once else " --previous")
    reason_of = TroubleReason.POD_FAILED if once else TroubleReason.CRASH_LOOP
    return Trouble(reason_of, f"{what} {verb}: it ended with {_ending(ended)}", f"its log: {log}")


def _ending(ended: Mapping[str, Any]) -> str:
    code, reason = ended["exitCode"], ended.get("reason")
    text = f"exit code {code}"
    if reason == "OOMKilled":
        text += ", killed for exceeding its memory limit"
    elif reason and reason != "Error":
        text += f" ({reason})"
    message = _plain(ended.get("message") or "")
    return f"{text}: {message}" if message else text


def _pull_cause(message: str) -> str:
    """The cause of a failed pull, without the part about the next attempt."""
    return _plain(re.sub(r'^Back-off pulling image "[^"]*"(: )?', "", message).removeprefix("ErrImagePull: "))


def _plain(message: str) -> str:
    """One line, without the wrapping of gRPC, and shortened."""
    line = " ".join(re.sub(r"rpc error: code = \w+ desc = ", "", str(message)).split())
    return cut(line, _LONGEST)
