"""Refusals by quotas, limit ranges and admission, recognised by the messages of the API server. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from application_manager.core.conditions import find_raw
from application_manager.core.health.pods import Trouble, TroubleReason
from wayside.times import parse_time

QUOTA_EXCEEDED = TroubleReason.QUOTA_EXCEEDED.value
ADMISSION_REFUSED = TroubleReason.ADMISSION_REFUSED.value
APPLY_REFUSED = "ApplyRefused"
FAILED_CREATE = "FailedCreate"
"""The reason of the Events of Kubernetes' controllers for pods that they cannot create."""

_RETRIED = 20 * 60.0  # s
_POD = re.compile(r'^.*?\bpods "[^"]*" is ', re.DOTALL)

_REMEDIES = {
    QUOTA_EXCEEDED: "raise the ResourceQuota, or wait until other objects are deleted; the manager retries",
    ADMISSION_REFUSED: "change the template or the admission policy; the manager retries",
}
_NO_RIGHT = re.compile(r"cannot \w+ resource")  # a missing permission of the manager's account


def reason_of(code: int, message: str) -> str:
    """The reason of a refusal: by a ResourceQuota, by other admission (LimitRange, policies, webhooks), or any other.

    `code` is the HTTP status. A quota responds with 403 and "exceeded quota" (`plugin/pkg/admission/resourcequota`), a
    LimitRange and PodSecurity with 403, a webhook or a policy with "denied", whatever the code.
    """
    if "exceeded quota" in message:
        return QUOTA_EXCEEDED
    if "denied the request" in message or "denied request" in message:
        return ADMISSION_REFUSED
    if code == 403 and not _NO_RIGHT.search(message):
        return ADMISSION_REFUSED
    return APPLY_REFUSED


def with_remedy(reason: str, message: str) -> str:
    """The message, with the remedy."""
    return f"{message}: {_REMEDIES[reason]}" if reason in _REMEDIES else message


def refused_pods(live: Mapping[str, Any]) -> Trouble | None:
    """Why the pods of a Deployment or ReplicaSet are refused, if they are; for other kinds only Events report it."""
    if live.get("kind") not in ("Deployment", "ReplicaSet"):
        return None
    failure = find_raw(live.get("status") or {}, "ReplicaFailure")
    return _trouble(str(failure.get("message", ""))) if failure.get("status") == "True" else None


def has_too_few_pods(live: Mapping[str, Any]) -> bool:
    """Whether a StatefulSet, DaemonSet or Job has too few pods; only Events give the reason."""
    spec, status = live.get("spec") or {}, live.get("status") or {}
    match live.get("kind"):
        case "StatefulSet":
            return (status.get("replicas") or 0) < int(spec.get("replicas", 1))
        case "DaemonSet":
            return (status.get("currentNumberScheduled") or 0) < (status.get("desiredNumberScheduled") or 0)
        case "Job":
            seen = any(status.get(each) for each in ("active", "succeeded", "failed", "completionTime"))
            return not seen and not spec.get("suspend")
    return False


def refused_by_events(events: Iterable[Mapping[str, Any]], now: float) -> Trouble | None:
    """Why pods are refused, by the last Event FailedCreate of a workload that has too few; None without a recent one.

    `now` is in seconds since 1970. The controllers retry after 17 minutes at the latest.
    """
    notes = [(_last(each), str(each.get("note", ""))) for each in events if each.get("reason") == FAILED_CREATE]
    at, note = max(notes, default=(0.0, ""))
    return _trouble(note) if now - at < _RETRIED else None


def without_names(message: str) -> str:
    """The message without the name of the pod, which differs at each attempt."""
    return _POD.sub("", message)


def _trouble(message: str) -> Trouble:
    short = without_names(message)
    reason = TroubleReason(_of_pods(short))
    return Trouble(reason, with_remedy(reason.value, f"pods are refused: {short}"))


def _of_pods(message: str) -> str:
    """Quota or admission: Kubernetes' own controllers have the permission to create pods."""
    return QUOTA_EXCEEDED if reason_of(403, message) == QUOTA_EXCEEDED else ADMISSION_REFUSED


def _last(event: Mapping[str, Any]) -> float:
    """The time of the last occurrence, in seconds since 1970, from any of the fields that its sender may fill."""
    series = event.get("series") or {}
    stamps = (series.get("lastObservedTime"), event.get("deprecatedLastTimestamp"), event.get("eventTime"))
    return max((parse_time(str(each)) / 1e9 for each in stamps if each), default=0.0)
