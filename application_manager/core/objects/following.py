"""Which pods mount an instance's configuration, and the annotation that announces a change to them. Pure.

The kubelet writes a changed ConfigMap into a pod at its next sync of that pod, which may be more than a minute away. It
syncs at once when the pod itself changes, and an annotation is enough. The annotation is a hash of the content, so the
same content is never announced twice.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from application_manager.core.claims import values
from application_manager.core.objects.configuration import config_map_name
from application_manager.core.objects.podspecs import pod_template

ANNOTATION = "wayside.dev/configuration"
"""On a pod: `fingerprint` of the configuration that was announced to it last."""

Object = Mapping[str, Any]

_OVER = ("Succeeded", "Failed")


def fingerprint(files: Mapping[str, str]) -> str:
    """A short hash of the content of the files."""
    return hashlib.sha256(values.canonical(dict(files)).encode()).hexdigest()[:16]


def selectors(objects: Iterable[Object]) -> tuple[str, ...]:
    """Label selectors that together cover the pods of these workloads; one that is empty covers all."""
    found = {_selector(each) for each in objects if pod_template(each)}
    return ("",) if "" in found else tuple(sorted(found))


def behind(pods: Iterable[Object], instance: str, content: str) -> Iterator[tuple[str, str]]:
    """Name and uid of the pods that mount the instance's configuration and do not have this content announced."""
    for pod in pods:
        metadata = pod["metadata"]
        going = "deletionTimestamp" in metadata or (pod.get("status") or {}).get("phase") in _OVER
        if going or (metadata.get("annotations") or {}).get(ANNOTATION) == content:
            continue
        if _mounts(pod, config_map_name(instance)):
            yield metadata["name"], metadata["uid"]


def _mounts(pod: Object, config_map: str) -> bool:
    for volume in (pod.get("spec") or {}).get("volumes") or ():
        sources = [volume, *((volume.get("projected") or {}).get("sources") or ())]
        if any((each.get("configMap") or {}).get("name") == config_map for each in sources):
            return True
    return False


def _selector(workload: Object) -> str:
    # What selects the pods, since that never changes; the template's labels may, and older pods keep theirs.
    labels = ((workload["spec"].get("selector") or {}).get("matchLabels")) or _labels(workload)
    return ",".join(f"{key}={value}" for key, value in sorted(labels.items()))


def _labels(workload: Object) -> Mapping[str, str]:
    labels: Mapping[str, str] = (pod_template(workload).get("metadata") or {}).get("labels") or {}
    return labels
