"""The workloads of a suspended instance, which are scaled to zero, and their replicas afterwards. Pure.

- A workload with the `scale` subresource is scaled to zero. This also pauses a HorizontalPodAutoscaler: it ignores a
  workload with zero replicas, and continues once there are replicas again. So the autoscaler itself is not changed.
- Jobs and CronJobs have a field for it, `spec.suspend`.
- A DaemonSet and a bare Pod cannot be scaled: they are deleted, and created again afterwards.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from application_manager.core.objects.ownership import ObjectKey, object_key

Json = dict[str, Any]

SCALED = frozenset({("apps/v1", "Deployment"), ("apps/v1", "StatefulSet")})
"""The allowable kinds with a `scale` subresource for their replicas."""

_SUSPENDABLE = frozenset({"Job", "CronJob"})
_REMOVED = frozenset({"DaemonSet", "Pod"})
_AUTOSCALER = "HorizontalPodAutoscaler"


def is_scaled(manifest: Mapping[str, Any]) -> bool:
    """Whether the object's replicas are set by its `scale` subresource."""
    return (manifest.get("apiVersion"), manifest.get("kind")) in SCALED


def without_autoscaled_replicas(manifests: Iterable[Json]) -> list[Json]:
    """The manifests; if one of them is an autoscaler for a workload, that workload has no `replicas`."""
    everything = list(manifests)
    autoscaled = {(each["kind"], each["name"]) for each in _targets(everything)}
    return [
        _with_spec(each, replicas=None)
        if is_scaled(each) and (each["kind"], each["metadata"]["name"]) in autoscaled
        else each
        for each in everything
    ]


def scaled_to_zero(manifests: Iterable[Json]) -> list[Json]:
    """The manifests as they are while the instance is suspended."""
    result = []
    for each in manifests:
        if is_scaled(each):
            result.append(_with_spec(each, replicas=0))
        elif each["kind"] in _SUSPENDABLE:
            result.append(_with_spec(each, suspend=True))
        elif each["kind"] not in _REMOVED:
            result.append(each)
    return result


def stated_replicas(manifests: Iterable[Json]) -> dict[ObjectKey, int | None]:
    """By workload with replicas, the number in its manifest; None if the manifest does not set it."""
    found: dict[ObjectKey, int | None] = {}
    for each in manifests:
        if is_scaled(each):
            spec = each.get("spec")
            stated = spec.get("replicas") if isinstance(spec, dict) else None
            valid = isinstance(stated, int) and not isinstance(stated, bool) and stated >= 0
            found[object_key(each)] = stated if valid else None
    return found


def autoscalers(manifests: Iterable[Mapping[str, Any]]) -> list[str]:
    """The names of the autoscalers among the manifests."""
    return sorted(each["metadata"]["name"] for each in manifests if each["kind"] == _AUTOSCALER)


def pods_left(live: Mapping[str, Any]) -> int:
    """The number of pods of a suspended workload that still exist, as far as its status shows."""
    status, spec = live.get("status") or {}, live.get("spec") or {}
    if (live.get("apiVersion"), live.get("kind")) in SCALED:
        return int(max(status.get("replicas") or 0, spec.get("replicas", 1)))
    return int(status.get("active") or 0) if live.get("kind") == "Job" else 0


def _targets(manifests: Iterable[Json]) -> Iterator[Mapping[str, Any]]:
    for each in manifests:
        spec = each.get("spec") if each["kind"] == _AUTOSCALER else None
        target = spec.get("scaleTargetRef") if isinstance(spec, dict) else None
        if isinstance(target, dict) and "kind" in target and "name" in target:
            yield target


def _with_spec(manifest: Json, **changes: Any) -> Json:
    """A copy with other members of the spec; None removes one."""
    spec = manifest.get("spec")
    if not isinstance(spec, dict):
        return manifest  # the API server reports the error
    changed = {key: value for key, value in copy.deepcopy(spec).items() if key not in changes}
    return {**manifest, "spec": changed | {key: value for key, value in changes.items() if value is not None}}
