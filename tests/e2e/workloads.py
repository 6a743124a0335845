"""Workloads for tests: their pods run Python, which Wayside's image has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tests.cluster.api import Api, Object, Objects
from tests.patience import NODE_PATIENCE


def deployment(
    name: str,
    image: str,
    command: Sequence[str],
    *,
    port: int = 0,
    container: Mapping[str, Any] | None = None,
    **pod: Any,
) -> Object:
    """Return a Deployment of one pod, ready when its port (if any) answers; `pod`: more fields of the pod's spec."""
    labels = {"app": name}
    main: Object = {"name": "main", "image": image, "command": list(command), "imagePullPolicy": "Never"}
    if port:
        main["ports"] = [{"containerPort": port}]
        main["readinessProbe"] = {"tcpSocket": {"port": port}, "periodSeconds": 1}
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": name},
        "spec": {
            "selector": {"matchLabels": labels},
            "template": {
                "metadata": {"labels": labels},
                "spec": {"containers": [main | dict(container or {})], "terminationGracePeriodSeconds": 1, **pod},
            },
        },
    }


def service(name: str, port: int, target: int = 0, **spec: Any) -> Object:
    """Return a Service of the pods labelled `app: <name>`."""
    ports = [{"port": port, "targetPort": target or port}]
    return {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {"name": name},
        "spec": {"selector": {"app": name}, "ports": ports, **spec},
    }


def wait_available(api: Api, name: str, timeout: float = NODE_PATIENCE) -> Object:
    """Wait until all pods of a Deployment are ready and match its current spec; return one of them."""

    def holds(found: Object) -> bool:
        status, wanted = found.get("status", {}), found["spec"]["replicas"]
        seen = status.get("observedGeneration") == found["metadata"]["generation"]
        return seen and status.get("updatedReplicas") == status.get("availableReplicas") == wanted

    api.wait_for("Deployment", name, holds, timeout=timeout, what=f"Deployment {name} is available")
    return running_pods(api, name)[0]


def running_pods(api: Api, name: str) -> Objects:
    """Return the pods of a Deployment that are not being deleted."""
    return [pod for pod in api.list("Pod", labels=f"app={name}") if "deletionTimestamp" not in pod["metadata"]]
