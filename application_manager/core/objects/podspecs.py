"""Finds the pod specs and the service accounts in a manifest of any kind, by their shape. Pure.

Kinds that an administrator allows may create pods in ways that the manager does not know (ReplicaSet, Rollout, Knative
Service), so any map with `containers` is treated as a pod spec.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

_USUAL = ("spec", "template")
POD_TEMPLATES: Mapping[str, tuple[str, ...]] = {
    "Pod": (),
    "PodTemplate": ("template",),
    **dict.fromkeys(("Deployment", "StatefulSet", "DaemonSet", "ReplicaSet", "ReplicationController", "Job"), _USUAL),
    "CronJob": ("spec", "jobTemplate", "spec", "template"),
}
"""The path of the pod, or the pod template, in a manifest of the kind."""

_CONTAINERS = ("containers", "initContainers")
_ACCOUNTS = ("serviceAccountName", "serviceAccount")
_TEXTS = {"ConfigMap": ("data", "binaryData"), "Secret": ("data", "stringData")}
"""Fields whose keys are the user's own."""


def at(value: Any, path: Iterable[str]) -> Mapping[str, Any]:
    """The map at the path in another one; empty if there is none."""
    for each in path:
        value = value.get(each) if isinstance(value, Mapping) else None
    return value if isinstance(value, Mapping) else {}


def pod_template(manifest: Mapping[str, Any]) -> Mapping[str, Any]:
    """The pod template of a manifest, in an unknown kind at `spec.template`; empty if there is none."""
    return at(manifest, POD_TEMPLATES.get(str(manifest.get("kind")), _USUAL))


def pod_spec(manifest: Mapping[str, Any]) -> Mapping[str, Any]:
    """The pod spec of a manifest; empty if there is none."""
    return at(pod_template(manifest), ("spec",))


def with_pod_template(manifest: dict[str, Any], change: Callable[[dict[str, Any]], dict[str, Any]]) -> dict[str, Any]:
    """The manifest with its pod template changed; unchanged if it has none, or is of an unknown kind."""
    path = POD_TEMPLATES.get(str(manifest.get("kind")))
    return manifest if path is None else _changed(manifest, path, change)


def _changed(value: dict[str, Any], path: tuple[str, ...], change: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    if not path:
        return dict(change(value))
    inner = value.get(path[0])
    return value | {path[0]: _changed(inner, path[1:], change)} if isinstance(inner, dict) else value


@dataclass(frozen=True, slots=True)
class PodSpec:
    """A pod spec in its manifest, and its field."""

    where: str
    spec: dict[str, Any]


@dataclass(frozen=True, slots=True)
class NamedAccount:
    """A service account in a field outside of pod specs."""

    where: str
    account: str


def pods_and_accounts(manifest: dict[str, Any]) -> Iterator[PodSpec | NamedAccount]:
    """The pod specs and service accounts, each with its field.

    Metadata, and the texts of ConfigMaps and Secrets, are ignored.
    """
    kind = str(manifest.get("kind"))
    path = POD_TEMPLATES.get(kind)
    known = "" if path is None else ".".join((*path, "spec"))
    for field, value in manifest.items():
        if field != "metadata" and field not in _TEXTS.get(kind, ()):
            yield from _within(field, value, known)


def _within(where: str, value: Any, known: str) -> Iterator[PodSpec | NamedAccount]:
    if isinstance(value, list):
        for index, each in enumerate(value):
            yield from _within(f"{where}[{index}]", each, known)
    elif isinstance(value, dict):
        if where == known or any(isinstance(value.get(each), list) for each in _CONTAINERS):
            yield PodSpec(where, value)
            return
        for field, each in value.items():
            if field in _ACCOUNTS and isinstance(each, str):
                yield NamedAccount(f"{where}.{field}", each)
            else:
                yield from _within(f"{where}.{field}", each, known)
