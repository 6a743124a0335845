"""Asking the cluster what an explanation needs: `application-manager explain`. It only reads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, TypeVar

from kubernetes.aio.config import ConfigException, list_kube_config_contexts

from application_manager.client import LEASES, ApiError, Client, Object, Resource, Unreachable
from application_manager.connection import load_configuration
from application_manager.core.claims import InvalidTemplate
from application_manager.core.explaining import Found, explain, serving
from application_manager.core.explanation import Explanation
from application_manager.core.labelling import INSTANCE_LABEL
from wayside.api import API_VERSION, ApplicationInstance, ApplicationTask, ApplicationTemplate, Kind
from wayside.api.documents import parse_object
from wayside.leases import lease_name

Model = TypeVar("Model", bound=Kind)

_contexts: Any = list_kube_config_contexts  # the package says that it is typed, yet this function is not

_TASKS = Resource(API_VERSION, "ApplicationTask", "applicationtasks")
_INSTANCES = Resource(API_VERSION, "ApplicationInstance", "applicationinstances")
_TEMPLATES = Resource(API_VERSION, "ApplicationTemplate", "applicationtemplates")
_PODS = Resource("v1", "Pod", "pods")

_TASK_WORDS = frozenset({"task", "apptask", "applicationtask", "applicationtasks"})
_INSTANCE_WORDS = frozenset({"instance", "appinst", "applicationinstance", "applicationinstances"})


class InquiryError(Exception):
    """What was asked about cannot be explained; the message is one line, with the remedy."""


async def inquire(subject: str, namespace: str | None) -> Explanation:
    """The explanation of a task or an instance.

    Args:
        subject: a name, or `task/<name>`, `instance/<name>` where there is one of each.
        namespace: None for the kubeconfig's, else `default`.

    Raises:
        InquiryError: there is no such thing, or the API server refuses to tell.
        ConfigurationError: there is no cluster.
    """
    client = Client(await load_configuration())
    try:
        return await _inquire(client, subject, namespace or _namespace_of_context())
    except (ApiError, Unreachable) as error:
        raise InquiryError(f"the API server does not tell: {error}") from error
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
    task = await _read(client, _TASKS, ApplicationTask, namespace, name, kind, _TASK_WORDS)
    existing = await _read(client, _INSTANCES, ApplicationInstance, namespace, name, kind, _INSTANCE_WORDS)
    if kind and kind.lower() not in _TASK_WORDS | _INSTANCE_WORDS:
        raise InquiryError(f"{subject}: {kind} is neither task nor instance: write task/{name} or instance/{name}")
    if task is None and existing is None:
        what = kind or "ApplicationTask or ApplicationInstance"
        raise InquiryError(
            f"there is no {what} {name!r} in namespace {namespace}: `kubectl get apptask,appinst -n {namespace}` lists "
            "those that there are, and -n says another namespace"
        )
    if task is not None and existing is not None:
        raise InquiryError(f"{name} is a task and an instance: write task/{name} or instance/{name}")
    template = task.spec.template if task else existing.spec.template if existing else ""
    tasks = await _list(client, _TASKS, ApplicationTask, namespace, template)
    found = Found(await _template(client, namespace, template), tasks, [])
    instance = serving(found, task) if task is not None else name
    if instance is not None and existing is None:
        existing = await _read(client, _INSTANCES, ApplicationInstance, namespace, instance)
    listed = existing.status.objects if existing and existing.status else []
    objects = {
        (each.api_version, each.kind, each.name): await _live(client, each.api_version, each.kind, namespace, each.name)
        for each in listed
    }
    pods, _ = await client.list(_PODS, namespace, labels=f"{INSTANCE_LABEL}={instance}") if instance else ([], "")
    holders = {task.spec.requester.holder} if task is not None else set()
    leases = {each: await client.get(LEASES, namespace, lease_name(each)) for each in holders if each}
    whole = Found(
        found.templates,
        tasks,
        [existing] if existing else [],
        objects,
        pods,
        {holder: lease for holder, lease in leases.items() if lease is not None},
    )
    return explain(whole, task=task.name if task else None, instance=instance, now=time.time())


async def _read(
    client: Client,
    resource: Resource,
    model: type[Model],
    namespace: str,
    name: str,
    kind: str = "",
    words: frozenset[str] = frozenset(),
) -> Model | None:
    """The object, or None where there is none or another kind was asked for."""
    if kind and kind.lower() not in words:
        return None
    raw = await client.get(resource, namespace, name)
    if raw is None:
        return None
    try:
        parsed = parse_object(raw)
    except ValueError as error:
        raise InquiryError(f"{resource.kind} {name} cannot be read: {error}: correct it") from error
    return parsed if isinstance(parsed, model) else None


async def _list(
    client: Client, resource: Resource, model: type[Model], namespace: str, template: str
) -> Sequence[Model]:
    raws, _ = await client.list(resource, namespace, fields=f"spec.template={template}")
    parsed = [_parsed(each) for each in raws]
    return [each for each in parsed if isinstance(each, model)]


async def _template(client: Client, namespace: str, name: str) -> list[ApplicationTemplate | InvalidTemplate]:
    raw = await client.get(_TEMPLATES, namespace, name)
    if raw is None:
        return []
    try:
        parsed = parse_object(raw)
    except ValueError as error:
        return [InvalidTemplate(name, str(error))]
    return [parsed] if isinstance(parsed, ApplicationTemplate) else []


async def _live(client: Client, api_version: str, kind: str, namespace: str, name: str) -> Object | None:
    resource = (await client.discover(api_version)).get((api_version, kind))
    return await client.get(resource, namespace, name) if resource is not None else None


def _parsed(raw: Object) -> Kind | None:
    try:
        return parse_object(raw)
    except ValueError:
        return None  # older than its CRD: it claims nothing, as its status says
