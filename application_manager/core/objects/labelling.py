"""The labels that identify an instance's objects and the pods of its workloads. Pure.

Pods have the instance's label alone: it never changes while the instance lives, so it never makes a workload roll out.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from application_manager.core.objects.podspecs import with_pod_template
from wayside.api import ApplicationInstance
from wayside.api.base import MANAGED_BY, MANAGED_BY_LABEL

INSTANCE_LABEL = "wayside.dev/instance"
TEMPLATE_LABEL = "wayside.dev/template"

Manifest = dict[str, Any]


def labelled(manifest: Manifest, instance: ApplicationInstance) -> Manifest:
    """The manifest in the instance's namespace and with its labels, and its pod template with the instance's."""
    metadata = manifest["metadata"]
    own = {
        MANAGED_BY_LABEL: MANAGED_BY,
        INSTANCE_LABEL: instance.name,
        TEMPLATE_LABEL: instance.spec.template_name,
    }
    made = (
        manifest if manifest["kind"] == "Pod" else with_pod_template(manifest, partial(_labelled_pods, instance.name))
    )
    return {
        **made,
        "metadata": {**metadata, "namespace": instance.namespace, "labels": {**(metadata.get("labels") or {}), **own}},
    }


def _labelled_pods(instance: str, template: Manifest) -> Manifest:
    """The pod template with the instance's label; one of a wrong shape is unchanged, and the API server rejects it."""
    metadata = template.get("metadata") or {}
    labels = (metadata.get("labels") or {}) if isinstance(metadata, dict) else None
    if not isinstance(labels, dict):
        return template
    return {**template, "metadata": {**metadata, "labels": {**labels, INSTANCE_LABEL: instance}}}
