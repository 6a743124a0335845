"""The objects of an owner, distinguished from others by their controller, uid and labels. Pure.

Pods have only the instance's label: it never changes during the life of the instance, so it never causes a rollout.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from application_manager.core.conditions import ConditionState
from application_manager.core.objects.podspecs import with_pod_template
from wayside.api import API_VERSION, ApplicationInstance, Kind
from wayside.api.applicationinstance import ObjectReference, SuspendedReplicas
from wayside.api.base import MANAGED_BY, MANAGED_BY_LABEL

FIELD_MANAGER = "wayside"
"""The manager's name in server-side apply."""

INSTANCE_LABEL = "wayside.dev/instance"
TEMPLATE_LABEL = "wayside.dev/template"

ObjectKey = tuple[str, str, str]
"""apiVersion, kind and name."""


Manifest = dict[str, Any]


@dataclass(frozen=True, slots=True)
class LastApplied:
    """The last apply: the digest of the last completely applied rendering, and the uids of the objects.

    A uid is None if the object may not have been applied.
    """

    digest: str | None = None
    objects: Mapping[ObjectKey, str | None] = field(default_factory=dict)

    @classmethod
    def read(cls, digest: str | None, references: Iterable[ObjectReference]) -> LastApplied:
        """The keys in references that `references` returned."""
        return cls(digest, {reference_key(each): each.uid for each in references})


@dataclass(frozen=True, slots=True)
class ApplyResult:
    """The result of an apply: the condition Applied, and the objects of the instance.

    `complete`: whether everything is as rendered; `took`: the start and the end of the apply, in nanoseconds since the
    epoch, None if nothing was applied.
    """

    state: ConditionState
    objects: tuple[ObjectReference, ...]
    complete: bool
    took: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class ApplyProblem:
    """Why objects are not applied: the reason of the condition Applied, and the problem with its remedy."""

    reason: str
    message: str


def controller_uid(live: Mapping[str, Any]) -> str | None:
    """The uid of the object's controller."""
    return controller_of(live).get("uid")


def controller_of(live: Mapping[str, Any]) -> Mapping[str, Any]:
    """The owner reference to the object's controller; empty if it has none."""
    owners: list[Mapping[str, Any]] = live["metadata"].get("ownerReferences") or []
    return next((each for each in owners if each.get("controller")), {})


def instance_of(live: Mapping[str, Any]) -> tuple[str, str] | None:
    """Namespace and name of the instance in the object's label."""
    metadata = live["metadata"]
    name = (metadata.get("labels") or {}).get(INSTANCE_LABEL)
    return (metadata["namespace"], name) if name else None


def foreign(live: Mapping[str, Any], owner: Kind, what: str, recorded: str | None = None) -> ApplyProblem | None:
    """Why the owner may not overwrite the object, or None if it belongs to the owner.

    `what`: the object's kind and name; `recorded`: its uid, if the owner's status lists it.
    """
    if live["metadata"].get("deletionTimestamp"):
        return ApplyProblem("Waiting", f"{what} is being deleted; the manager applies it again afterwards")
    controller = controller_of(live)
    if not controller:
        if live["metadata"]["uid"] == recorded:
            return None
    elif controller["uid"] == owner.metadata.uid:
        return None
    elif (controller["apiVersion"], controller["kind"], controller["name"]) == (API_VERSION, owner.kind, owner.name):
        return ApplyProblem("Waiting", f"{what} of the previous {owner.kind} {owner.name} is still being deleted")
    whose = f"is controlled by {controller['kind']} {controller['name']}" if controller else "has no controller"
    remedy = f"delete or rename it, or choose another name in {owner.kind} {owner.name}"
    return ApplyProblem(
        "ObjectExists", f"{what} already exists and {whose}, so the manager does not change it: {remedy}"
    )


def reference_key(of: ObjectReference | SuspendedReplicas) -> ObjectKey:
    """The key of the object of a reference in a status."""
    return of.api_version, of.kind, of.name


def references(uids: Mapping[ObjectKey, str | None]) -> tuple[ObjectReference, ...]:
    """The objects for a status, in a fixed order."""
    return tuple(
        ObjectReference(api_version=key[0], kind=key[1], name=key[2], uid=uid) for key, uid in sorted(uids.items())
    )


def owned(manifest: Manifest, instance: ApplicationInstance) -> Manifest:
    """The manifest with the owner, which has a uid by now, as its controller."""
    owner = {
        "apiVersion": API_VERSION,
        "kind": instance.kind,
        "name": instance.name,
        "uid": instance.metadata.uid,
        "controller": True,
    }
    return {**manifest, "metadata": {**manifest["metadata"], "ownerReferences": [owner]}}


def object_key(manifest: Mapping[str, Any]) -> ObjectKey:
    """The keys of the objects of one instance: apiVersion, kind and name."""
    return manifest["apiVersion"], manifest["kind"], manifest["metadata"]["name"]


def our_fields(raw: Mapping[str, Any]) -> str:
    """The fields that this manager owns; another client that updates them takes them over."""
    for each in raw["metadata"].get("managedFields") or []:
        if each.get("manager") == FIELD_MANAGER and each.get("operation") == "Apply" and not each.get("subresource"):
            return json.dumps(each.get("fieldsV1"), sort_keys=True)
    return ""


def labelled(manifest: Manifest, instance: ApplicationInstance) -> Manifest:
    """The manifest in the instance's namespace and with its labels, and its pod template with the instance's label."""
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
    """The pod template with the instance's label; an invalid one is unchanged, and the API server rejects it."""
    metadata = template.get("metadata") or {}
    labels = (metadata.get("labels") or {}) if isinstance(metadata, dict) else None
    if not isinstance(labels, dict):
        return template
    return {**template, "metadata": {**metadata, "labels": {**labels, INSTANCE_LABEL: instance}}}
