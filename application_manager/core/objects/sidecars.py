"""The detector as a sidecar: the patch for a pod whose label names a Detector. Pure.

The webhook adds it to pods, and `application-manager inject` to manifests. It is a native sidecar, an init container
that is always restarted: it starts before the pod's own containers, ends after them, and keeps no Job from completing.

The sidecar must not impair the pod, so nothing waits for it: no startup probe delays the other containers, and no
readiness probe removes the pod from its Services. It comes after all other init containers, which need no detector.
Its names do not collide with those of the pod. Its token is a separate volume, regardless of the token mounts that the
pod or its service account configure.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from application_manager.core.objects.detectors import (
    Manifest,
    container,
    field_variable,
    probe,
    pull_secrets,
    run_as,
    volumes_of,
)
from application_manager.core.objects.poddefaults import PodDefaults
from wayside.api import Detector
from wayside.api.pod import VOLUME_PREFIX

SIDECAR_LABEL = "wayside.dev/detector"
"""On pods: the Detector that they request."""
CONTAINER = "wayside-detector"
"""The name of the container. A pod with a container of this name already has its detector."""

_TOKEN = f"{VOLUME_PREFIX}token"
_TOKEN_FOLDER = "/var/run/secrets/kubernetes.io/serviceaccount"  # noqa: S105  a folder
_TOKEN_SECONDS = 3607  # the kubelet renews it in time; the value that Kubernetes itself uses
_METRICS = "wayside-metrics"  # scrapers find ports by their names, over all containers of a pod
_FIRST_PORT = 9464  # not 9100, which many pods use
_STARTING = 120  # s until a missing health response counts


@dataclass(frozen=True, slots=True)
class Addition:
    """The additions to the lists of a pod's spec, by their fields."""

    items: dict[str, list[Manifest]]


class SidecarError(ValueError):
    """With the sidecar, the pod would not be valid, and could not be created."""


def addition(spec: Mapping[str, Any], detector: Detector, defaults: PodDefaults) -> Addition | None:
    """The fields to add to the spec of a pod for the Detector's sidecar; None if it has the sidecar already.

    Raises SidecarError if the two are not compatible.
    """
    if has_sidecar(spec):
        return None
    volumes, mounts = volumes_of(detector, defaults, VOLUME_PREFIX)
    volumes.append(_token())
    mounts.append({"name": _TOKEN, "mountPath": _TOKEN_FOLDER, "readOnly": True})
    paths = [each["mountPath"].rstrip("/") for each in mounts]
    for path in paths:
        if paths.count(path) > 1:
            raise SidecarError(f"Detector {detector.name} has two volumes at {path}: give its folder another path")
    there = {each.get("name"): each for each in _list(spec, "volumes")}
    for each in volumes:
        if each["name"] in there and there[each["name"]] != each:
            raise SidecarError(
                f"spec.volumes: the name {each['name']} is reserved for the detector: rename the pod's volume"
            )
    keys = {each.get("name") for each in _list(spec, "imagePullSecrets")}
    items = {
        "initContainers": [_sidecar(detector, defaults, mounts, _port(spec))],
        "volumes": [each for each in volumes if each["name"] not in there],
        "imagePullSecrets": [each for each in pull_secrets(detector, defaults) if each["name"] not in keys],
    }
    return Addition({field: each for field, each in items.items() if each})


def has_sidecar(spec: Mapping[str, Any]) -> bool:
    """Whether the spec of a pod has the detector's container, even if its author wrote it."""
    return any(each.get("name") == CONTAINER for each in _all_containers(spec))


def sidecar_pods(pods: Iterable[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
    """The sidecars of pods, each as if its pod had no other containers."""
    for pod in pods:
        spec, status = pod.get("spec") or {}, pod.get("status") or {}
        if has_sidecar(spec):
            yield {
                "metadata": pod["metadata"],
                "spec": {"initContainers": [each for each in _all_containers(spec) if each.get("name") == CONTAINER]},
                "status": {
                    "phase": status.get("phase"),
                    "initContainerStatuses": [
                        each
                        for field in ("initContainerStatuses", "containerStatuses")
                        for each in _list(status, field)
                        if each.get("name") == CONTAINER
                    ],
                },
            }


def added(spec: Mapping[str, Any], given: Addition) -> Manifest:
    """The pod's spec with the addition."""
    return {**spec, **{field: [*_list(spec, field), *items] for field, items in given.items.items()}}


def patch(spec: Mapping[str, Any], given: Addition) -> list[dict[str, Any]]:
    """The addition as a JSON patch of the pod (RFC 6902), which changes nothing else."""
    operations: list[dict[str, Any]] = []
    for field, items in given.items.items():
        if _list(spec, field):
            operations += [{"op": "add", "path": f"/spec/{field}/-", "value": each} for each in items]
        else:
            operations.append({"op": "add", "path": f"/spec/{field}", "value": items})
    return operations


def _sidecar(detector: Detector, defaults: PodDefaults, mounts: list[Manifest], port: int | None) -> Manifest:
    made = container(detector, defaults, mounts, name=CONTAINER, port=port, port_name=_METRICS)
    made["command"] += ["--as-pod", "--namespace=$(POD_NAMESPACE)"]
    made["env"].append(field_variable("POD_NAMESPACE", "metadata.namespace"))
    for each in made["env"]:  # a missing Secret would prevent the start of the whole pod
        for reference in ("secretKeyRef", "configMapKeyRef"):
            if reference in each.get("valueFrom", {}):
                each["valueFrom"][reference] |= {"optional": True}
    # The pod's own securityContext belongs to its author: the sidecar sets all that the restricted standard requires.
    made["securityContext"] |= {
        "runAsNonRoot": True,
        **run_as(defaults),
        "seccompProfile": {"type": "RuntimeDefault"},
    }
    health = (
        {}
        if port is None
        else {"livenessProbe": probe(defaults, "/healthz", 10, 3, _METRICS) | {"initialDelaySeconds": _STARTING}}
    )
    return made | {"restartPolicy": "Always"} | health


def _port(spec: Mapping[str, Any]) -> int | None:
    """A port for metrics and health that no other container of the pod declares.

    None in a pod with hostNetwork: another pod on the node could use the port, which would keep this pod off the node.
    """
    if spec.get("hostNetwork"):
        return None
    taken = {port.get("containerPort") for each in _all_containers(spec) for port in _list(each, "ports")}
    return next(port for port in range(_FIRST_PORT, 65536) if port not in taken)


def _token() -> Manifest:
    """The service account's token, bound to the pod: the same volume that the ServiceAccount admission mounts."""
    sources = [
        {"serviceAccountToken": {"path": "token", "expirationSeconds": _TOKEN_SECONDS}},
        {"configMap": {"name": "kube-root-ca.crt", "items": [{"key": "ca.crt", "path": "ca.crt"}]}},
        {"downwardAPI": {"items": [{"path": "namespace", "fieldRef": {"fieldPath": "metadata.namespace"}}]}},
    ]
    return {"name": _TOKEN, "projected": {"sources": sources}}


def _all_containers(spec: Mapping[str, Any]) -> Iterable[Mapping[str, Any]]:
    return [*_list(spec, "initContainers"), *_list(spec, "containers")]


def _list(of: Mapping[str, Any], field: str) -> list[Any]:
    return of.get(field) or []
