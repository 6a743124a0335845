"""The labels by which an instance's objects, and the pods of its workloads, are found again. Pure.

Pods have the instance's label alone: it never changes while the instance lives, so it never makes a workload roll out.
"""

from __future__ import annotations

from typing import Any

from wayside.api import ApplicationInstance
from wayside.api.base import MANAGED_BY, MANAGED_BY_LABEL

INSTANCE_LABEL = "wayside.dev/instance"
TEMPLATE_LABEL = "wayside.dev/template"

_POD_TEMPLATES: dict[tuple[str, str], tuple[str, ...]] = {
    ("apps/v1", "Deployment"): ("spec", "template"),
    ("apps/v1", "StatefulSet"): ("spec", "template"),
    ("apps/v1", "DaemonSet"): ("spec", "template"),
    ("batch/v1", "Job"): ("spec", "template"),
    ("batch/v1", "CronJob"): ("spec", "jobTemplate", "spec", "template"),
}

Manifest = dict[str, Any]


def labelled(manifest: Manifest, instance: ApplicationInstance) -> Manifest:
    """The manifest in the instance's namespace and with its labels, and those of its pods in place."""
    metadata = manifest["metadata"]
    own = {
        MANAGED_BY_LABEL: MANAGED_BY,
        INSTANCE_LABEL: instance.name,
        TEMPLATE_LABEL: instance.spec.template_name,
    }
    _label_pods(manifest, instance)
    return {
        **manifest,
        "metadata": {**metadata, "namespace": instance.namespace, "labels": {**(metadata.get("labels") or {}), **own}},
    }


def _label_pods(manifest: Manifest, instance: ApplicationInstance) -> None:
    """Label the manifest's pod template, in place; what is of a wrong shape the API server refuses, as it stands."""
    path = _POD_TEMPLATES.get((manifest["apiVersion"], manifest["kind"]))
    here: Any = manifest
    for part in path or ("",):
        here = here.get(part) if isinstance(here, dict) else None
    if not isinstance(here, dict):
        return
    metadata = here.get("metadata") or {}
    labels = (metadata.get("labels") or {}) if isinstance(metadata, dict) else None
    if isinstance(labels, dict):
        here["metadata"] = {**metadata, "labels": {**labels, INSTANCE_LABEL: instance.name}}
