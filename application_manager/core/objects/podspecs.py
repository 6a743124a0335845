"""Finds the pod specs and the service accounts in a manifest of any kind, by their shape. Pure.

Kinds that an administrator allows may make pods in ways that nobody foresaw here (ReplicaSet, Rollout, Knative
Service), so what has `containers` is a pod's spec wherever it stands.
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
"""Where the pod, or the template of pods, is in a manifest of the kind."""

_CONTAINERS = ("containers", "initContainers")
_ACCOUNTS = ("serviceAccountName", "serviceAccount")
_TEXTS = {"ConfigMap": ("data", "binaryData"), "Secret": ("data", "stringData")}
"""Fields whose keys are the user's own."""


def at(value: Any, path: Iterable[str]) -> Mapping[str, Any]:
    """The map at the path in another one; empty where there is none."""
    for each in path:
        value = value.get(each) if isinstance(value, Mapping) else None
    return value if isinstance(value, Mapping) else {}


def pod_template(manifest: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the pods of a manifest are made of, in an unknown kind at `spec.template`; empty where there is none."""
    return at(manifest, POD_TEMPLATES.get(str(manifest.get("kind")), _USUAL))


def pod_spec(manifest: Mapping[str, Any]) -> Mapping[str, Any]:
    """The spec of a manifest's pods; empty where there is none."""
    return at(pod_template(manifest), ("spec",))


def with_pod_template(manifest: dict[str, Any], change: Callable[[dict[str, Any]], dict[str, Any]]) -> dict[str, Any]:
    """The manifest with its pod template changed; as it is where it has none, or is of an unknown kind."""
    path = POD_TEMPLATES.get(str(manifest.get("kind")))
    return manifest if path is None else _changed(manifest, path, change)


def _changed(value: dict[str, Any], path: tuple[str, ...], change: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    if not path:
        return dict(change(value))
    inner = value.get(path[0])
    return value | {path[0]: _changed(inner, path[1:], change)} if isinstance(inner, dict) else value


@dataclass(frozen=True, slots=True)
class PodSpec:
    """A pod spec, as it is in its manifest, and its field."""

    where: str
    spec: dict[str, Any]


@dataclass(frozen=True, slots=True)
class NamedAccount:
    """A service account that a field outside of pod specs names."""

    where: str
    account: str


def pods_and_accounts(manifest: dict[str, Any]) -> Iterator[PodSpec | NamedAccount]:
    """All of them, each with its field; what is metadata, or the text of a ConfigMap or Secret, is neither."""
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
