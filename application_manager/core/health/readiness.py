"""Whether an object is ready, by its status. Pure.

The rules are those of `kubectl rollout status` for workloads, and the conditions Ready and Available for all other
kinds. An object without either is ready once it exists.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from application_manager.core.conditions import find_raw
from application_manager.core.health.refusals import without_names

_OBSERVED = frozenset({"Deployment", "StatefulSet", "DaemonSet"})
_LOAD_BALANCER = "LoadBalancer"


def not_ready(live: Mapping[str, Any]) -> str | None:
    """Why the object is not ready, as words that follow its name; None if it is ready.

    A workload is ready when its controller has processed its current spec, and all its pods are available and of that
    spec. A Job is ready once it runs or has completed, a PersistentVolumeClaim once it is bound, a Service of type
    LoadBalancer once it has an address.
    """
    status = live.get("status") or {}
    spec = live.get("spec") or {}
    match live.get("kind"):
        case "Deployment":
            return _stale(live, status) or _deployment(spec, status)
        case "StatefulSet":
            return _stale(live, status) or _stateful_set(spec, status)
        case "DaemonSet":
            return _stale(live, status) or _daemon_set(spec, status)
        case "Pod":
            return None if _condition(status, "Ready") or status.get("phase") == "Succeeded" else "is not ready"
        case "Job":
            return _job(spec, status)
        case "PersistentVolumeClaim":
            return _claim(status)
        case "Service":
            pending = spec.get("type") == _LOAD_BALANCER and not (status.get("loadBalancer") or {}).get("ingress")
            return "has no load balancer address yet" if pending else None
    return _by_conditions(live, status)


def is_unobserved(live: Mapping[str, Any]) -> bool:
    """Whether the object is a workload whose controller has not processed its current spec yet."""
    status = live.get("status") or {}
    return live.get("kind") in _OBSERVED and _stale(live, status) is not None


def _stale(live: Mapping[str, Any], status: Mapping[str, Any]) -> str | None:
    seen, generation = status.get("observedGeneration", 0), live["metadata"].get("generation", 0)
    return None if seen >= generation else "has not been processed by its controller yet"


def _deployment(spec: Mapping[str, Any], status: Mapping[str, Any]) -> str | None:
    desired = _replicas(spec)
    updated = status.get("updatedReplicas") or 0
    problem = _count("available", status.get("availableReplicas"), desired) or _present(updated, desired)
    left = (status.get("replicas") or 0) - updated
    if problem is None and left > 0:
        problem = f"still runs {left} pod{'' if left == 1 else 's'} of its previous version"
    if problem is None:
        return None
    refused = find_raw(status, "ReplicaFailure")
    if refused.get("status") == "True":
        return f"{problem}, and pods cannot be created: {without_names(str(refused.get('message', '')))}"
    progress = find_raw(status, "Progressing")
    if progress.get("status") == "False":
        return f"{problem}, and makes no progress"
    return problem


def _stateful_set(spec: Mapping[str, Any], status: Mapping[str, Any]) -> str | None:
    desired = _replicas(spec)
    problem = _count("available", status.get("availableReplicas"), desired)
    strategy = spec.get("updateStrategy") or {}
    partial = strategy.get("type") == "OnDelete" or (strategy.get("rollingUpdate") or {}).get("partition")
    if problem is None and not partial and status.get("updateRevision") != status.get("currentRevision"):
        return _present(status.get("updatedReplicas") or 0, desired)
    return problem


def _daemon_set(spec: Mapping[str, Any], status: Mapping[str, Any]) -> str | None:
    desired = status.get("desiredNumberScheduled")
    if desired is None:
        return "is not scheduled yet"
    problem = _count("available", status.get("numberAvailable"), desired)
    if problem is None and (spec.get("updateStrategy") or {}).get("type") != "OnDelete":
        return _present(status.get("updatedNumberScheduled") or 0, desired)
    return problem


def _job(spec: Mapping[str, Any], status: Mapping[str, Any]) -> str | None:
    failed = find_raw(status, "Failed")
    if failed.get("status") == "True":
        return f"has failed: {failed.get('message') or failed.get('reason') or 'no reason given'}"
    if spec.get("suspend"):
        return "is suspended (spec.suspend)"
    running = (status.get("ready") or 0) > 0 or (status.get("succeeded") or 0) > 0
    return None if running or _condition(status, "Complete") else "has no running pod"


def _claim(status: Mapping[str, Any]) -> str | None:
    match status.get("phase"):
        case "Bound":
            return None
        case "Lost":
            return "has lost its volume"
    return "is not bound to a volume yet"


def _by_conditions(live: Mapping[str, Any], status: Mapping[str, Any]) -> str | None:
    """Why an object of any other kind is not ready, by its condition Ready, else Available."""
    if not isinstance(status, Mapping) or not isinstance(status.get("conditions", []), list):
        return None  # a kind with a status of another shape
    for type_ in ("Ready", "Available"):
        condition = find_raw(status, type_)
        if not condition:
            continue
        if isinstance(seen := status.get("observedGeneration"), int) and seen < live["metadata"].get("generation", 0):
            return "has not been processed by its controller yet"
        if condition.get("status") == "True":
            return None
        why = condition.get("message") or condition.get("reason") or "no reason given"
        return f"is not {type_.lower()}: {why}"
    return None


def _replicas(spec: Mapping[str, Any]) -> int:
    replicas = spec.get("replicas")
    return 1 if replicas is None else int(replicas)


def _count(word: str, have: int | None, want: int) -> str | None:
    return None if (have or 0) >= want else f"has {have or 0} of {want} pods {word}"


def _present(have: int, want: int) -> str | None:
    return _count("of its current version", have, want)


def _condition(status: Mapping[str, Any], type_: str) -> bool:
    return bool(find_raw(status, type_).get("status") == "True")
