"""Reads the objects for `application-manager explain` from the cluster. Never writes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

from kubernetes.aio.config import ConfigException, list_kube_config_contexts

from application_manager.cache.cluster_cache import INSTANCES, TASKS, TEMPLATES
from application_manager.cluster.client import manager_client
from application_manager.core.claims.claims import InvalidTemplate
from application_manager.core.objects.ownership import INSTANCE_LABEL
from application_manager.core.statuses.explaining import NamespaceSnapshot, explanation_of, serving
from application_manager.core.statuses.explanation import Explanation
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate, Kind
from wayside.api.documents import parse_object
from wayside.inputerror import InputError
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import load_configuration
from wayside.kubernetes.errors import RequestError
from wayside.kubernetes.leases import lease_name
from wayside.kubernetes.resources import LEASES, Object, Resource

Model = TypeVar("Model", bound=Kind)

_contexts: Any = list_kube_config_contexts  # the package claims to be typed, yet this function is not

_PODS = Resource("v1", "Pod", "pods")

_TASK_WORDS = frozenset({"", "task", "apptask", "applicationtask", "applicationtasks"})
_INSTANCE_WORDS = frozenset({"", "instance", "appinst", "applicationinstance", "applicationinstances"})


class InquiryError(InputError):
    """The object cannot be explained; the message is one line, with the remedy."""


async def inquire(subject: str, namespace: str | None) -> Explanation:
    """The explanation of a task or an instance, given its name, `task/<name>` or `instance/<name>`.

    `namespace` None: the kubeconfig's, else `default`. Raises InquiryError if there is no such object, or the API
    server refuses to return it, and ConfigurationError if there is no cluster.
    """
    client = manager_client(await load_configuration())
    try:
        return await _inquire(client, subject, namespace or _namespace_of_context())
    except RequestError as error:
        raise InquiryError(f"the API server does not respond: {error}") from error
    finally:
        await client.close()


def _namespace_of_context() -> str:
    try:
        _, active = _contexts()
    except (ConfigException, OSError):
        return "default"  # in a pod
    return str((active or {}).get("context", {}).get("namespace") or "default")


async def _inquire(client: Client, subject: str, namespace: str) -> Explanation:
    kind, _, name = subject.rpartition("/")
    of = kind.lower()
    if of not in _TASK_WORDS | _INSTANCE_WORDS:
        raise InquiryError(f"{subject}: must be task/{name} or instance/{name}; got the kind {kind}")
    task = await _read(client, TASKS, ApplicationTask, namespace, name) if of in _TASK_WORDS else None
    existing = await _read(client, INSTANCES, ApplicationInstance, namespace, name) if of in _INSTANCE_WORDS else None
    if task is None and existing is None:
        what = kind or "ApplicationTask or ApplicationInstance"
        raise InquiryError(
            f"there is no {what} {name!r} in namespace {namespace}: list them with `kubectl get apptask,appinst -n "
            f"{namespace}`, or give another namespace with -n"
        )
    if task is not None and existing is not None:
        raise InquiryError(f"{name} is the name of a task and of an instance: write task/{name} or instance/{name}")
    snapshot = NamespaceSnapshot(
        await _templates(client, namespace),
        await _list(client, TASKS, ApplicationTask, namespace),
        await _list(client, INSTANCES, ApplicationInstance, namespace),
    )
    now = time.time()
    instance = serving(snapshot, task, now) if task is not None else name
    existing = next((each for each in snapshot.instances if each.name == instance), None)
    listed = existing.status.objects if existing and existing.status else []
    objects = {
        (each.api_version, each.kind, each.name): await _live(client, each.api_version, each.kind, namespace, each.name)
        for each in listed
    }
    pods, _ = await client.list(_PODS, namespace, labels=f"{INSTANCE_LABEL}={instance}") if instance else ([], "")
    holders = {task.spec.requester.holder} if task is not None else set()
    leases = {each: await client.get(LEASES, namespace, lease_name(each)) for each in holders if each}
    there = {holder: lease for holder, lease in leases.items() if lease is not None}
    whole = replace(snapshot, objects=objects, pods=pods, leases=there)
    return explanation_of(whole, task=task.name if task else None, instance=instance, now=now)


async def _read(client: Client, resource: Resource, model: type[Model], namespace: str, name: str) -> Model | None:
    """The object, or None if there is none."""
    raw = await client.get(resource, namespace, name)
    if raw is None:
        return None
    try:
        parsed = parse_object(raw)
    except ValueError as error:
        raise InquiryError(f"{resource.kind} {name} is not valid: {error}: correct it") from error
    return parsed if isinstance(parsed, model) else None


async def _list(client: Client, resource: Resource, model: type[Model], namespace: str) -> Sequence[Model]:
    """All objects of the namespace: places under a limit, and fallbacks, depend on the other objects too."""
    raws, _ = await client.list(resource, namespace)
    parsed = [_parsed(each) for each in raws]
    return [each for each in parsed if isinstance(each, model)]


async def _templates(client: Client, namespace: str) -> list[ApplicationTemplate | InvalidTemplate]:
    found: list[ApplicationTemplate | InvalidTemplate] = []
    for raw in (await client.list(TEMPLATES, namespace))[0]:
        try:
            parsed = parse_object(raw)
        except ValueError as error:
            found.append(InvalidTemplate(raw["metadata"]["name"], str(error)))
        else:
            found += [parsed] if isinstance(parsed, ApplicationTemplate) else []
    return found


async def _live(client: Client, api_version: str, kind: str, namespace: str, name: str) -> Object | None:
    resource = (await client.discover(api_version)).get((api_version, kind))
    return await client.get(resource, namespace, name) if resource is not None else None


def _parsed(raw: Object) -> Kind | None:
    try:
        return parse_object(raw)
    except ValueError:
        return None  # older than its CRD: it claims nothing, as its status shows
