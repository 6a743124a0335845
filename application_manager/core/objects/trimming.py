"""Trims objects for the cache to the fields that decisions read. Pure.

An object may have 1.5 MB, and Python needs several times that. So the cache does not contain the texts of ConfigMaps
and Secrets, containers, managed fields of others, foreign annotations and the values of a task's event.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from application_manager.core.objects.configuration import config_map_key
from application_manager.core.objects.ownership import instance_of, object_key
from wayside.api import ApplicationTemplate
from wayside.api.base import GROUP

Object = dict[str, Any]

_CONTAINERS = frozenset({"containers", "initContainers", "ephemeralContainers", "volumes"})
_SPEC_IS_READ = frozenset({"Deployment", "StatefulSet", "DaemonSet", "Job", "CronJob", "Pod", "Service"})
_CONTENT = frozenset({"data", "binaryData", "stringData"})
_OF_TASKS = ("templateName",)  # fields of a task's spec that are read in addition to its model


def own(raw: Object) -> Object:
    """An object of our kinds, reduced to the fields that its model needs."""
    lean = {**raw, "metadata": _metadata(raw, managers=())}
    spec = raw.get("spec")
    if raw.get("kind") == "ApplicationTask" and isinstance(spec, dict) and isinstance(spec.get("event"), dict):
        lean["spec"] = {**spec, "event": {key: value for key, value in spec["event"].items() if key != "values"}}
    return lean


def beside_model(lean: Object) -> Object:
    """The raw fields to keep for an object of our kinds, beside its model; there are many tasks and instances."""
    if lean["kind"] not in ("ApplicationTask", "ApplicationInstance"):
        return lean
    spec, status = lean.get("spec") or {}, lean.get("status") or {}
    kept = {"phase": status["phase"]} if "phase" in status else {}
    names = ("name", "namespace", "uid", "resourceVersion", "labels", "ownerReferences", "deletionTimestamp")
    return {
        "apiVersion": lean["apiVersion"],
        "kind": lean["kind"],
        "metadata": {key: lean["metadata"][key] for key in names if key in lean["metadata"]},
        "spec": {key: spec[key] for key in _OF_TASKS if key in spec},
        "status": kept,
    }


def others(raw: Object, manager: str) -> Object:
    """The fields to keep for an object of another kind; of its managed fields, those of `manager`, to detect drift."""
    kept = {key: value for key, value in raw.items() if key not in _CONTENT and key != "spec"}
    kept["metadata"] = _metadata(raw, managers=(manager,))
    if raw["kind"] in _SPEC_IS_READ and "spec" in raw:
        kept["spec"] = _without_containers(raw["spec"])
    if "data" in raw and _is_configuration(raw):
        kept["data"] = raw["data"]
    return kept


def without_objects(template: ApplicationTemplate) -> ApplicationTemplate:
    """The template without its objects and status, which may be large and do not affect claims."""
    less: dict[str, Any] = {"manifests": [], "configuration": {}, "helm": None}
    return template.model_copy(update={"spec": template.spec.model_copy(update=less), "status": None})


def _is_configuration(raw: Object) -> bool:
    """Whether the object is the ConfigMap of an instance's files, which are published."""
    owner = instance_of(raw)
    return owner is not None and object_key(raw) == config_map_key(owner[1])


def _metadata(raw: Object, managers: tuple[str, ...]) -> Object:
    metadata = raw["metadata"]
    kept = {key: value for key, value in metadata.items() if key not in ("managedFields", "annotations")}
    fields = [each for each in metadata.get("managedFields") or () if each.get("manager") in managers]
    annotations = {
        key: value for key, value in (metadata.get("annotations") or {}).items() if key.startswith(f"{GROUP}/")
    }
    return kept | ({"managedFields": fields} if fields else {}) | ({"annotations": annotations} if annotations else {})


def _without_containers(spec: Any) -> Any:
    """The spec without the pod's content; the fields for scheduling stay."""
    if not isinstance(spec, Mapping):
        return spec
    kept = {key: value for key, value in spec.items() if key not in _CONTAINERS}
    for path in ("template", "jobTemplate", "spec"):
        if isinstance(kept.get(path), Mapping):
            kept[path] = _without_containers(kept[path])
    return kept
