"""The objects that the manager should have created in a namespace, computed from the live objects, and the differences.

The expectation comes from `demand` and `Renderer`, called here on the live objects: regardless of the manager's
history, the cluster must eventually equal this pure function of them, and no other object may have the manager's label.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from application_manager.core.claims.claims import InvalidTemplate
from application_manager.core.claims.operations import VerdictKind
from application_manager.core.demand.decisions import is_managed
from application_manager.core.demand.demand import NamespaceOutcome, demand
from application_manager.core.demand.lingering import is_held
from application_manager.core.holders.leases import LeaseView
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer, RenderError
from application_manager.core.statuses.status import task_status
from tests.cluster.api import Api, Object
from tests.cluster.processes import Process, Processes
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate

KINDS = ("Deployment", "ConfigMap", "Service", "HorizontalPodAutoscaler")  # the kinds that the tests' templates create
MANAGED = "app.kubernetes.io/managed-by=wayside"


def start_manager(
    processes: Processes, namespace: str | None = None, *options: str, kubeconfig: Path | None = None
) -> Process:
    """Start `application-manager run` for the namespace (default: all) and wait until it watches.

    It receives an identity, as in a pod: after a restart it reacquires its own Lease at once.
    """
    where = ["--namespace", namespace] if namespace is not None else []
    environment = {"POD_NAME": "manager", "POD_UID": secrets.token_hex(8)}
    if kubeconfig is not None:
        environment["KUBECONFIG"] = str(kubeconfig)
    manager = processes.start("application-manager", "run", *where, "--resync", "5s", *options, environment=environment)
    manager.wait_for_output("watching")
    return manager


def wait_settled(
    api: Api,
    *,
    timeout: float = PATIENCE,
    lost: Mapping[str, LeaseView] | None = None,
    refused: Collection[str] = (),
    limit: int | None = None,
) -> None:
    """Wait until the objects of the namespace match its live demands.

    Args:
        api: for the namespace.
        timeout: seconds.
        lost: holders to treat as lost.
        refused: instances whose objects the API server rejects; these are not compared.
        limit: the maximum number of instances in the namespace.
    """
    wait_until(
        lambda: list(differences(api, lost or {}, refused, limit)),
        lambda found: not found,
        timeout=timeout,
        what="the cluster equals the pure function of the live objects",
    )


def differences(
    api: Api, leases: Mapping[str, LeaseView], refused: Collection[str] = (), limit: int | None = None
) -> Iterator[str]:
    """The differences between the existing and the expected objects."""
    templates = {raw["metadata"]["name"]: _template(raw) for raw in api.list("ApplicationTemplate")}
    tasks = [ApplicationTask.model_validate(raw) for raw in api.list("ApplicationTask")]
    instances = {
        raw["metadata"]["name"]: ApplicationInstance.model_validate(raw) for raw in api.list("ApplicationInstance")
    }
    objects = {(raw["kind"], raw["metadata"]["name"]): raw for kind in KINDS for raw in api.list(kind, labels=MANAGED)}
    outcome = demand(templates.values(), tasks, instances.values(), leases, time.time(), limit)
    expected: set[tuple[str, str]] = set()
    for name, instance in instances.items():
        decision = outcome.instances[name]
        if decision.paused:  # left unchanged, in any state
            expected |= {key for key, raw in objects.items() if name in raw["metadata"]["labels"].values()}
            continue
        if decision.demanded:
            if instance.spec.parameters != decision.parameters:
                yield f"{name}: parameters {instance.spec.parameters}, not {decision.parameters}"
            if decision.suspended is not None and instance.spec.suspended != decision.suspended:
                yield f"{name}: suspended is {instance.spec.suspended}, not {decision.suspended}"
        elif is_managed(instance) and not is_held(instance):
            if instance.status is None or instance.status.release_time is None:
                yield f"{name}: no task demands it, and it does not linger"
            elif decision.release_time is not None and decision.release_time < time.time():
                yield f"{name}: no task demands it, and its linger has ended"
        if name in refused:
            expected |= {key for key, raw in objects.items() if name in raw["metadata"]["labels"].values()}
        else:
            expected |= yield from _objects(instance, templates.get(instance.spec.template_name), objects)
    for name in outcome.instances.keys() - instances.keys():
        yield f"{name}: should exist"
    for leaked in objects.keys() - expected:
        yield f"{leaked}: has the manager's label, but belongs to no instance"
    yield from _tasks(tasks, outcome)


def _template(raw: Object) -> ApplicationTemplate | InvalidTemplate:
    try:
        return ApplicationTemplate.model_validate(raw)
    except ValidationError as error:
        return InvalidTemplate(raw["metadata"]["name"], str(error))


def _objects(
    instance: ApplicationInstance,
    template: ApplicationTemplate | InvalidTemplate | None,
    objects: Mapping[tuple[str, str], Object],
) -> Iterator[Any]:
    expected: set[tuple[str, str]] = set()
    status = instance.status
    recorded = {(each.kind, each.name): each.uid for each in status.objects} if status else {}
    try:
        rendering = Renderer(template, Policy()).render(instance) if isinstance(template, ApplicationTemplate) else None
    except RenderError:
        rendering = None
    if rendering is None:  # the last good state is kept
        return set(recorded)
    for manifest in rendering.manifests:
        key = (manifest["kind"], manifest["metadata"]["name"])
        expected.add(key)
        live = objects.get(key)
        if live is None:
            yield f"{instance.name}: {key} is missing"
            continue
        owners = [each["uid"] for each in live["metadata"].get("ownerReferences", [])]
        if owners != [instance.metadata.uid]:
            yield f"{instance.name}: {key} is owned by {owners}"
        if recorded.get(key) != live["metadata"]["uid"]:
            yield f"{instance.name}: the status has {recorded.get(key)} as the uid of {key}"
        yield from (f"{instance.name}: {key} {problem}" for problem in _unlike(manifest, live, ""))
    if status is None or status.spec_hash != rendering.digest:
        yield f"{instance.name}: specHash is not that of its manifests"
    if recorded.keys() != expected:
        yield f"{instance.name}: the status lists {sorted(recorded)}"
    return expected


def _unlike(wanted: Any, live: Any, path: str) -> Iterator[str]:
    """The fields of the manifest that the live object does not have; it may have more."""
    if isinstance(wanted, dict) and isinstance(live, dict):
        for key, value in wanted.items():
            yield from _unlike(value, live.get(key), f"{path}.{key}")
    elif isinstance(wanted, list) and isinstance(live, list) and len(wanted) == len(live):
        for index, (one, other) in enumerate(zip(wanted, live, strict=True)):
            yield from _unlike(one, other, f"{path}[{index}]")
    elif wanted != live:
        yield f"has {live!r} at {path}, not {wanted!r}"


def _tasks(tasks: list[ApplicationTask], outcome: NamespaceOutcome) -> Iterator[str]:
    for task in tasks:
        verdict = outcome.verdicts[task.name]
        if task.status is None:
            yield f"task {task.name}: has no status"
            continue
        should = task_status(task, verdict, None, time.time(), task.metadata.generation)
        if task.status.instance_name != should.instance_name:
            yield f"task {task.name}: instance {task.status.instance_name}, not {should.instance_name}"
        if verdict.kind is not VerdictKind.COUNTS and task.status.phase != should.phase:
            yield f"task {task.name}: phase {task.status.phase}, not {should.phase}"
        logged = {each.type: (each.status, each.reason) for each in task.status.conditions}
        for each in should.conditions:
            if logged.get(each.type) != (each.status, each.reason):
                yield f"task {task.name}: {each.type} is {logged.get(each.type)}, not {(each.status, each.reason)}"


# --- Objects of the tests


def template(name: str = "app", *, image: str = "app:1", linger: str = "1s", **spec: Any) -> Object:
    """A template with one Deployment for each region."""
    keyed = {"parameters": {"region": {"type": "string", "required": True}}, "key": "${parameters.region}"}
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "ApplicationTemplate",
        "metadata": {"name": name},
        "spec": {**keyed, "lifecycle": {"linger": linger}, "manifests": [deployment(image)], **spec},
    }


def deployment(image: str = "app:1", name: str = "${instance.name}") -> Object:
    labels = {"app": name}
    containers = [{"name": "main", "image": image}]
    pod = {"metadata": {"labels": labels}, "spec": {"containers": containers}}
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": name},
        "spec": {"replicas": 1, "selector": {"matchLabels": labels}, "template": pod},
    }


def config(data: Mapping[str, str], name: str = "${instance.name}-config") -> Object:
    return {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": name}, "data": dict(data)}


def task(name: str, *, of: str = "app", holder: str | None = None, **parameters: Any) -> Object:
    """A task for a region, by default the region with the task's name."""
    spec: Object = {"templateName": of, "parameters": {"region": name} | parameters}
    if holder is not None:
        spec["requester"] = {"holder": holder}
    return {"apiVersion": "wayside.dev/v1alpha1", "kind": "ApplicationTask", "metadata": {"name": name}, "spec": spec}


def end(api: Api, name: str) -> None:
    """End a task's demand, as its holder would."""
    now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    api.patch("ApplicationTask", name, {"spec": {"endTime": now}})


def condition(raw: Object, type_: str) -> Object:
    """The object's condition of the type; empty if it has none."""
    conditions = raw.get("status", {}).get("conditions", [])
    found: Object = next((each for each in conditions if each["type"] == type_), {})
    return found


def has_status(raw: Object) -> bool:
    """Whether the manager has written the status: a new object has Ready Unknown with observedGeneration 0."""
    return condition(raw, "Ready").get("observedGeneration", 0) > 0


def only_instance(api: Api) -> Object:
    """The only existing instance."""
    (found,) = api.wait_list("ApplicationInstance", lambda found: len(found) == 1, what="exactly one instance exists")
    return found
