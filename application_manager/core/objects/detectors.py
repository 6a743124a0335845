"""The objects of a detector that the manager runs: a service account, its permissions, and the Deployment. Pure.

For a detector in other pods (mode Sidecar, see `sidecars`), these are only the permissions, for the service accounts of
those pods. The Deployment contains only the parts of the Detector that concern the pod: the image, resources, volumes
and Secrets. The detector itself watches the rest of the Detector, and its rules, so a change of these restarts nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import PurePosixPath
from typing import Any

from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.core.objects.rights import bound, detector_rights, merged_rules, sidecar_rights
from wayside.api import API_VERSION, Detector
from wayside.api.pod import OF_ITS_OWN_POD, DetectorMode, DetectorPod

Manifest = dict[str, Any]

DETECTOR_LABEL = "wayside.dev/runs"
"""On all objects of a detector, and on its pods: the Detector's name."""
MANAGED_BY = "app.kubernetes.io/managed-by"
MANAGER = "application-manager"
SELECTOR = f"{DETECTOR_LABEL},{MANAGED_BY}={MANAGER}"
"""The label selector of all objects of detectors that managers run."""

KINDS = (
    ("v1", "ServiceAccount", "serviceaccounts"),
    ("rbac.authorization.k8s.io/v1", "Role", "roles"),
    ("rbac.authorization.k8s.io/v1", "RoleBinding", "rolebindings"),
    ("apps/v1", "Deployment", "deployments"),
)
"""apiVersion, kind and plural of a detector's objects, in the order of dependencies."""

METRICS, METRICS_PORT = "metrics", 9100
_SECRETS_FOLDER = "/etc/wayside/secrets"  # where the detector expects them
_METRICS_FOLDER = "/etc/wayside/metrics-certificates"  # not among the Secrets that rules may use
_SECRET_FIELDS = frozenset({"tlsSecretName", "credentialsSecretName", "uriSecretName"})
_AS_GIVEN = frozenset(OF_ITS_OWN_POD) - {"securityContext"}
_SCRATCH_SIZE = "256Mi"


def object_name(detector: str) -> str:
    """The name of all objects of the Detector."""
    return f"detector-{detector}"


def detector_roles(namespace: str, detector: str) -> list[Manifest]:
    """The service account, the Role and the RoleBinding with exactly the permissions that the detector needs."""
    name = object_name(detector)
    account = {
        "apiVersion": "v1",
        "kind": "ServiceAccount",
        "metadata": {"name": name, "namespace": namespace},
        "automountServiceAccountToken": False,
    }
    return [account, *bound(name, namespace, merged_rules(detector_rights(detector)), (namespace, name))]


def sidecar_roles(namespace: str, detector: str, accounts: Iterable[str]) -> list[Manifest]:
    """The Role and the RoleBinding with the permissions that the detector needs in other pods, for their accounts."""
    whose = [(namespace, each) for each in sorted(set(accounts))]
    return list(bound(object_name(detector), namespace, merged_rules(sidecar_rights(detector)), *whose))


def detector_objects(detector: Detector, defaults: PodDefaults) -> list[Manifest]:
    """All objects of the Detector, as they are to be applied: with labels and owner."""
    if detector.spec.mode is DetectorMode.SIDECAR:
        made = sidecar_roles(detector.namespace, detector.name, detector.spec.service_account_names or ())
    else:
        made = [*detector_roles(detector.namespace, detector.name), _deployment(detector, defaults)]
    for each in made:
        each["metadata"] |= {"labels": _labels(detector.name), "ownerReferences": [_owner(detector)]}
    return made


def deployment_to_try(detector: Detector, defaults: PodDefaults) -> Manifest:
    """The Deployment of a Standalone detector for a dry run: with an unused name, and without owner."""
    made = _deployment(detector, defaults)
    made["metadata"]["name"] += ".dry-run"
    return made


def secrets_of(detector: Detector) -> list[str]:
    """The Secrets that its pod mounts: those in the Detector, and those that its rules may use."""
    pod = detector.spec.pod or DetectorPod()
    return sorted({*_named(detector.spec.to_json()), *pod.secret_names})


def _named(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, child in value.items():
            if key in _SECRET_FIELDS and isinstance(child, str):
                yield child
            else:
                yield from _named(child)
    elif isinstance(value, list):
        for child in value:
            yield from _named(child)


def _owner(detector: Detector) -> Manifest:
    return {
        "apiVersion": API_VERSION,
        "kind": "Detector",
        "name": detector.name,
        "uid": detector.metadata.uid,
        "controller": True,
        "blockOwnerDeletion": False,
    }


def _labels(name: str) -> dict[str, str]:
    return {
        "app.kubernetes.io/name": "wayside",
        "app.kubernetes.io/component": "detector",
        MANAGED_BY: MANAGER,
        DETECTOR_LABEL: name,
    }


def _deployment(detector: Detector, defaults: PodDefaults) -> Manifest:
    name = object_name(detector.name)
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": name, "namespace": detector.namespace},
        "spec": {
            "replicas": 1,
            "strategy": {"type": "Recreate"},  # two pods of one name would wait for each other's Lease
            "selector": {"matchLabels": {MANAGED_BY: MANAGER, DETECTOR_LABEL: detector.name}},
            "template": {"metadata": {"labels": _labels(detector.name)}, "spec": _pod(detector, defaults)},
        },
    }


def _pod(detector: Detector, defaults: PodDefaults) -> Manifest:
    """The pod, as the restricted Pod Security Standard requires."""
    pod = detector.spec.pod or DetectorPod()
    volumes, mounts = volumes_of(detector, defaults)
    probes = {
        "startupProbe": probe(defaults, "/healthz", 2, 60),
        "livenessProbe": probe(defaults, "/healthz", 10, 3),
        "readinessProbe": probe(defaults, "/readyz", 5, 2),
    }
    return {
        "serviceAccountName": object_name(detector.name),
        "automountServiceAccountToken": True,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": 30,
        "securityContext": {
            "runAsNonRoot": True,
            **run_as(defaults),
            **({} if defaults.user is None else {"fsGroup": defaults.user}),  # makes volumes writable for it
            "fsGroupChangePolicy": "OnRootMismatch",
            "seccompProfile": {"type": "RuntimeDefault"},
            **(pod.security_context or {}),
        },
        **({"imagePullSecrets": keys} if (keys := pull_secrets(detector, defaults)) else {}),
        **{field: value for field, value in pod.to_json().items() if field in _AS_GIVEN and value},
        "containers": [container(detector, defaults, mounts) | probes],
        "volumes": volumes,
    }


def container(
    detector: Detector,
    defaults: PodDefaults,
    mounts: list[Manifest],
    *,
    name: str = "detector",
    port: int | None = METRICS_PORT,
    port_name: str = METRICS,
) -> Manifest:
    """The container that runs the Detector, without probes.

    `mounts`: as returned by `volumes_of`; `port`: of metrics and health, None: do not serve them; `port_name`: for
    scrapers.
    """
    pod = detector.spec.pod or DetectorPod()
    metrics = {} if port is None else {"ports": [{"name": port_name, "containerPort": port, "protocol": "TCP"}]}
    return {
        "name": name,
        "image": pod.image or defaults.image,
        **({"imagePullPolicy": str(defaults.pull_policy)} if defaults.pull_policy else {}),
        "command": [
            "detector",
            "run",
            f"--name={detector.name}",
            *([] if port is None else [f"--metrics-port={port}"]),
            *([] if port is None or not defaults.metrics_secret else [f"--metrics-certificates={_METRICS_FOLDER}"]),
        ],
        "env": _environment(pod, defaults),
        **metrics,
        "resources": pod.resources.to_json(),
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "capabilities": {"drop": ["ALL"]},
            "readOnlyRootFilesystem": True,
        },
        "volumeMounts": mounts,
    }


def pull_secrets(detector: Detector, defaults: PodDefaults) -> list[Manifest]:
    """The Secrets for pulling the image: those of all detectors, then its own."""
    own = [each.name for each in detector.spec.pod.image_pull_secrets] if detector.spec.pod is not None else []
    return [{"name": each} for each in dict.fromkeys((*defaults.pull_secrets, *own))]


def run_as(defaults: PodDefaults) -> Manifest:
    """The user of a detector in a security context."""
    return {} if defaults.user is None else {"runAsUser": defaults.user, "runAsGroup": defaults.user}


def field_variable(variable: str, path: str) -> Manifest:
    """An environment variable with a field of the pod, by the downward API."""
    return {"name": variable, "valueFrom": {"fieldRef": {"fieldPath": path}}}


def probe(defaults: PodDefaults, path: str, period: int, failures: int, port_name: str = METRICS) -> Manifest:
    """A probe of the container's port for metrics and health, every `period` seconds."""
    get = {"path": path, "port": port_name, **({"scheme": "HTTPS"} if defaults.metrics_secret else {})}
    return {"httpGet": get, "periodSeconds": period, "timeoutSeconds": 5, "failureThreshold": failures}


def _environment(pod: DetectorPod, defaults: PodDefaults) -> list[Manifest]:
    """The pod's identity, then the variables of all detectors, unless the Detector overrides them, then its own."""

    given: dict[str, Manifest] = {name: {"value": value} for name, value in sorted(defaults.environment.items())}
    for each in pod.env:
        given.pop(each.name, None)
        source = each.value_from
        given[each.name] = {"value": each.value or ""} if source is None else {"valueFrom": source.to_json()}
    own = [field_variable("POD_NAME", "metadata.name"), field_variable("POD_UID", "metadata.uid")]
    return [*own, *({"name": name, **value} for name, value in given.items())]


def volumes_of(detector: Detector, defaults: PodDefaults, prefix: str = "") -> tuple[list[Manifest], list[Manifest]]:
    """The volumes, and their mounts. A missing Secret does not prevent the start.

    `prefix`: the start of the volumes' names.
    """
    pod = detector.spec.pod or DetectorPod()
    scratch = f"{prefix}scratch"
    volumes: list[Manifest] = [{"name": scratch, "emptyDir": {"sizeLimit": _SCRATCH_SIZE}}]
    mounts: list[Manifest] = [{"name": scratch, "mountPath": "/tmp"}]  # noqa: S108  a mount of the pod's own
    volumes += [each.to_json() | {"name": f"{prefix}{each.name}"} for each in pod.volumes]
    for each in sorted(pod.volume_mounts, key=lambda each: each.mount_path):
        given = {field: value for field, value in each.to_json().items() if value}
        mounts.append(given | {"name": f"{prefix}{each.name}"})
    for index, path in enumerate(_without_volume(detector, pod)):
        volumes.append({"name": f"{prefix}folder-{index}", "emptyDir": {}})
        mounts.append({"name": f"{prefix}folder-{index}", "mountPath": path})
    named = enumerate(secrets_of(detector))
    secrets = [(f"{prefix}secret-{index}", each, f"{_SECRETS_FOLDER}/{each}") for index, each in named]
    if defaults.metrics_secret is not None:
        secrets.append((f"{prefix}metrics", defaults.metrics_secret, _METRICS_FOLDER))
    for name, secret, folder in secrets:
        volumes.append({"name": name, "secret": {"secretName": secret, "optional": True}})
        mounts.append({"name": name, "mountPath": folder, "readOnly": True})
    return volumes, mounts


def _without_volume(detector: Detector, pod: DetectorPod) -> list[str]:
    """The folders that are in no volume, without those inside another one."""
    found: list[PurePosixPath] = []
    there = [PurePosixPath(each.mount_path) for each in pod.volume_mounts] + [PurePosixPath("/tmp")]  # noqa: S108  see above
    for path in sorted(map(PurePosixPath, detector.spec.folders.values())):
        if not any(path.is_relative_to(each) for each in (*there, *found)):
            found.append(path)
    return list(map(str, found))
