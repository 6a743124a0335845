"""Whether an object that exists also does its work, judged by its status. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def not_ready(live: Mapping[str, Any]) -> str | None:
    """Why the object is not ready, in words that follow its name; None if it is.

    Workloads are ready when their controller has seen their present spec and all their pods are available. A Job is
    ready once it runs or has completed. All other kinds are ready by being there.
    """
    status = live.get("status") or {}
    spec = live.get("spec") or {}
    match live.get("kind"):
        case "Deployment" | "StatefulSet":
            return _stale(live, status) or _count("available", status.get("availableReplicas"), spec.get("replicas", 1))
        case "DaemonSet":
            wanted = status.get("desiredNumberScheduled")
            if wanted is None:
                return "is not scheduled yet"
            return _stale(live, status) or _count("available", status.get("numberAvailable"), wanted)
        case "Pod":
            return None if _condition(status, "Ready") or status.get("phase") == "Succeeded" else "is not ready"
        case "Job":
            if _condition(status, "Failed"):
                return "has failed"
            running = (status.get("ready") or 0) > 0 or (status.get("succeeded") or 0) > 0
            return None if running or _condition(status, "Complete") else "has no pod that runs"
        case "PersistentVolumeClaim":
            return "has lost its volume" if status.get("phase") == "Lost" else None
    return None


def _stale(live: Mapping[str, Any], status: Mapping[str, Any]) -> str | None:
    seen, generation = status.get("observedGeneration", 0), live["metadata"].get("generation", 0)
    return None if seen >= generation else "has not been looked at by its controller yet"


def _count(word: str, have: int | None, want: int | None) -> str | None:
    wanted = 1 if want is None else want
    return None if (have or 0) >= wanted else f"has {have or 0} of {wanted} pods {word}"


def _condition(status: Mapping[str, Any], type_: str) -> bool:
    return any(each.get("type") == type_ and each.get("status") == "True" for each in status.get("conditions") or ())
