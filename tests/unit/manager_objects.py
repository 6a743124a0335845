"""Templates, tasks and instances for the tests of the manager's core, as short as possible."""

from __future__ import annotations

from typing import Any

from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate
from wayside.times import format_seconds

NOW = 1_790_000_000.0

DEPLOYMENT: dict[str, Any] = {
    "apiVersion": "apps/v1",
    "kind": "Deployment",
    "metadata": {"name": "${instance.name}"},
    "spec": {
        "replicas": 1,
        "selector": {"matchLabels": {"app": "${instance.name}"}},
        "template": {
            "metadata": {"labels": {"app": "${instance.name}"}},
            "spec": {"containers": [{"name": "main", "image": "registry.example/app:1"}]},
        },
    },
}


def template(name: str = "app", **spec: Any) -> ApplicationTemplate:
    return ApplicationTemplate.model_validate(
        {
            "kind": "ApplicationTemplate",
            "metadata": {"name": name, "namespace": "site"},
            "spec": spec if "helm" in spec else {"manifests": [DEPLOYMENT], **spec},
        }
    )


def task(
    name: str,
    parameters: dict[str, Any] | None = None,
    *,
    of: str = "app",
    priority: int = 0,
    operation: str = "Deploy",
    created: int = 0,
    holder: str | None = None,
    ended: bool = False,
    accepted_condition: tuple[str, str, float] | None = None,
) -> ApplicationTask:
    """`accepted_condition`: status, reason and transition time of the condition Accepted."""
    spec: dict[str, Any] = {
        "templateName": of, "operation": operation, "priority": priority, "parameters": parameters or {},
    }  # fmt: skip
    if holder:
        spec["requester"] = {"holder": holder}
    if ended:
        spec["endTime"] = format_seconds(NOW)
    raw: dict[str, Any] = {
        "kind": "ApplicationTask",
        "metadata": {"name": name, "namespace": "site", "creationTimestamp": format_seconds(NOW - 3600 + created)},
        "spec": spec,
    }
    if accepted_condition:
        status, reason, since = accepted_condition
        condition = {
            "type": "Accepted",
            "status": status,
            "reason": reason,
            "lastTransitionTime": format_seconds(since),
        }
        raw["status"] = {"conditions": [condition]}
    return ApplicationTask.model_validate(raw)


def instance(
    name: str = "app",
    *,
    of: str = "app",
    key: str | None = None,
    parameters: dict[str, Any] | None = None,
    suspended: bool = False,
    by_person: bool = False,
    release_at: float | None = None,
    annotations: dict[str, str] | None = None,
) -> ApplicationInstance:
    raw: dict[str, Any] = {
        "kind": "ApplicationInstance",
        "metadata": {
            "name": name,
            "namespace": "site",
            "uid": f"uid-{name}",
            "labels": {} if by_person else {"app.kubernetes.io/managed-by": "wayside"},
            "annotations": annotations or {},
        },
        "spec": {"templateName": of, "key": key, "parameters": parameters or {}, "suspended": suspended},
    }
    if release_at is not None:
        raw["status"] = {"releaseTime": format_seconds(release_at)}
    return ApplicationInstance.model_validate(raw)
