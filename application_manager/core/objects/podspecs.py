"""The pod specs in a manifest, and the accounts that it names elsewhere, found by their shape: whatever its kind. Pure.

Kinds that an administrator allows may make pods in ways that nobody foresaw here (ReplicaSet, Rollout, Knative
Service), so what has `containers` is a pod's spec wherever it stands.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

_KNOWN: Mapping[str, tuple[str, ...]] = {
    "Pod": ("spec",),
    "Deployment": ("spec", "template", "spec"),
    "StatefulSet": ("spec", "template", "spec"),
    "DaemonSet": ("spec", "template", "spec"),
    "Job": ("spec", "template", "spec"),
    "CronJob": ("spec", "jobTemplate", "spec", "template", "spec"),
}
"""Where these have theirs, also where it has no containers yet."""

_CONTAINERS = ("containers", "initContainers")
_ACCOUNTS = ("serviceAccountName", "serviceAccount")
_TEXTS = {"ConfigMap": ("data", "binaryData"), "Secret": ("data", "stringData")}
"""Fields whose keys are the user's own."""


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
    known = ".".join(_KNOWN.get(kind, ()))
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
