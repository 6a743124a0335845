"""The manager reads from the API server before it stops anything, since its cache may be incomplete.

The manager's parts run in the test process, since a test cannot remove objects from another process's cache.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.cluster.client import manager_client
from application_manager.core.claims.claims import instance_name
from application_manager.core.demand.decisions import Decision
from application_manager.core.objects.policy import Name, Policy
from application_manager.watching.router import Router
from application_manager.work.applying import Applier
from application_manager.work.instances import InstanceWork
from application_manager.work.recorder import Recorder
from application_manager.work.scaling import WorkloadScaler
from tests.cluster.api import Api
from tests.cluster.expected_objects import deployment, task, template
from tests.inprocess import objects
from wayside.api import API_VERSION
from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import load_configuration
from wayside.kubernetes.resources import Object, Resource

LINGERING = {"phase": "Lingering", "releaseTime": "2020-01-01T00:00:00Z"}
NORTH = instance_name("app", "north")


def ignore(*_: object) -> None:
    """Replaces the queues, which do not run here."""


def work_on(cache: ClusterCache, client: Client) -> tuple[Router, InstanceWork]:
    resources = {("apps/v1", "Deployment"): Resource("apps/v1", "Deployment", "deployments")}
    applier = Applier(client, cache.store, resources)
    router = Router(cache, applier, ignore, ignore, ignore, ignore, ignore)
    absent: Callable[[Name, Decision | None], None] = ignore
    work = InstanceWork(
        cache=cache,
        client=client,
        applier=applier,
        recorder=Recorder(client),
        scaler=WorkloadScaler(client, applier, router.observe),
        enqueue_at=ignore,
        enqueue=ignore,
        done=ignore,
        absent=absent,
        observe=router.observe,
        configured=ignore,
        objects=objects,
    )
    return router, work


def reconcile(api: Api, known: list[Object]) -> None:
    """Reconcile the instance once, with only these objects in the cache."""

    async def run() -> None:
        client = manager_client(await load_configuration())
        try:
            router, work = work_on(ClusterCache(Policy()), client)
            for raw in known:
                router.observe(raw)
            await work.reconcile((api.namespace, NORTH))
        finally:
            await client.close()

    asyncio.run(run())


def lingering(api: Api) -> list[Object]:
    """A template, and an instance whose linger has ended, as stored at the API server."""
    made = api.create(template())
    managed = {"app.kubernetes.io/managed-by": "wayside"}
    api.create(
        {
            "apiVersion": API_VERSION,
            "kind": "ApplicationInstance",
            "metadata": {"name": NORTH, "labels": managed},
            "spec": {"templateName": "app", "key": "north", "parameters": {"region": "north"}},
        }
    )
    return [made, api.patch("ApplicationInstance", NORTH, {"status": LINGERING}, subresource="status")]


def test_a_task_missed_by_the_watch_keeps_its_instance(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KUBECONFIG", str(api.kubeconfig))
    known = lingering(api)
    api.create(task("north"))
    reconcile(api, known)
    assert "deletionTimestamp" not in api.get("ApplicationInstance", NORTH)["metadata"]
    assert api.get("Deployment", NORTH)["spec"]["replicas"] == 1


def test_an_instance_without_demand_is_released(api: Api, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KUBECONFIG", str(api.kubeconfig))
    reconcile(api, lingering(api))
    api.wait_gone("ApplicationInstance", NORTH)


def test_an_object_controlled_by_the_instance_is_pruned_though_its_status_does_not_list_it(
    api: Api, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KUBECONFIG", str(api.kubeconfig))
    known = lingering(api)
    known.append(api.create(task("north")))
    owner = {key: known[1][key] for key in ("apiVersion", "kind")} | {
        "name": NORTH,
        "uid": known[1]["metadata"]["uid"],
        "controller": True,
    }
    labels = {"app.kubernetes.io/managed-by": "wayside", "wayside.dev/instance": NORTH}
    spec = deployment(name="other")["spec"]
    for name, owners in (("forgotten", [owner]), ("bystander", [])):
        metadata = {"name": name, "labels": labels, "ownerReferences": owners}
        known.append(api.create({"apiVersion": "apps/v1", "kind": "Deployment", "metadata": metadata, "spec": spec}))
    reconcile(api, known)
    api.wait_gone("Deployment", "forgotten")
    assert api.find("Deployment", "bystander") is not None
    assert api.find("Deployment", NORTH) is not None
