"""The objects of an instance: foreign objects are left alone, and its status lists new ones before they are applied."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.core.objects.ownership import ApplyResult, LastApplied, owned, references
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer
from application_manager.work.applying import Applier
from tests.unit.manager.memory_server import CONFIG_MAPS, MemoryServer, a_cache, raw, work_on
from tests.unit.manager_objects import instance, task, template
from wayside.kubernetes.resources import Object

NAME = ("site", "app")
APP = instance()
OTHER = instance("other")


def config(name: str, **data: str) -> Object:
    return {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": name}, "data": data}


def there(name: str, owner: Any = None, uid: str = "") -> Object:
    """A ConfigMap in the cluster, with or without an instance as its controller."""
    made = config(name)
    made["metadata"] |= {"namespace": "site", **({"uid": uid} if uid else {})}
    return made if owner is None else owned(made, owner)


def key(name: str) -> tuple[str, str, str]:
    return "v1", "ConfigMap", name


def applied(
    server: MemoryServer, *names: str, known: LastApplied | None = None, meanwhile: Object | None = None
) -> ApplyResult:
    """Apply ConfigMaps of these names; `meanwhile`: objects created between the read and the apply."""

    async def run() -> ApplyResult:
        rendering = Renderer(template(manifests=[config(name, new="yes") for name in names]), Policy()).render(APP)
        applier = Applier(server, ClusterCache(Policy()).store, {key("")[:2]: CONFIG_MAPS})  # type: ignore[arg-type]
        current = await applier.current_objects("site", rendering.manifests)
        if meanwhile is not None:
            server.put(meanwhile)
        return await applier.apply(APP, rendering, rendering.manifests, known or LastApplied(), current)

    return asyncio.run(run())


@pytest.mark.parametrize("owner", [None, OTHER])
def test_a_foreign_object_is_left_alone_and_nothing_is_pruned(owner: Any) -> None:
    server = MemoryServer(there("taken", owner), there("old", APP, "uid-old"))
    found = applied(server, "taken", "free", known=LastApplied("before", {key("old"): "uid-old"}))
    assert (found.state.holds, found.state.reason, found.complete) == (False, "ObjectExists", False)
    assert server.written == [("apply", "ConfigMap", "free")]
    assert {each.name for each in found.objects} == {"taken", "free", "old"}


def test_an_object_replaced_since_it_was_read_is_left_alone() -> None:
    server = MemoryServer(there("a", APP, "uid-old"))
    found = applied(server, "a", meanwhile=there("a", OTHER, "uid-new"))
    assert found.state.reason == "Waiting"
    assert server.written == []


def test_objects_no_longer_rendered_are_pruned_if_still_owned() -> None:
    server = MemoryServer(there("old", APP, "uid-old"), there("taken-over", OTHER, "uid-taken"))
    known = LastApplied("before", {key("old"): "uid-old", key("taken-over"): "uid-taken", key("gone"): "uid-gone"})
    found = applied(server, "new", known=known)
    assert found.complete
    assert server.written == [("apply", "ConfigMap", "new"), ("delete", "ConfigMap", "old")]
    assert {each.name for each in found.objects} == {"new"}


def reconciled(*manifests: Object) -> tuple[MemoryServer, ClusterCache]:
    """An instance that has ConfigMap a, reconciled once with these manifests in its template."""
    objects = [each.to_json() for each in references({key("a"): "uid-a"})]
    made = raw(APP, 1)
    made["status"] = {"objects": objects, "specHash": "before", "conditions": []}
    server = MemoryServer()
    known = [server.put(raw(template(manifests=list(manifests)), 1)), server.put(made)]
    server.put(there("a", APP, "uid-a"))
    cache = a_cache(*known, task=task("t"))
    asyncio.run(work_on(cache, server, []).reconcile(NAME))
    return server, cache


def test_the_status_lists_new_objects_before_they_are_applied() -> None:
    server, cache = reconciled(config("a"), config("b"))
    assert server.written[-3:] == [
        ("status", "ApplicationInstance", "app"),
        ("apply", "ConfigMap", "a"),
        ("apply", "ConfigMap", "b"),
    ]
    announced = {
        each["name"]: each.get("uid") for each in server.objects[("ApplicationInstance", "app")]["status"]["objects"]
    }
    assert announced == {"a": "uid-a", "b": None}
    assert cache.records[NAME].applied.complete


def test_objects_stay_and_remain_listed_while_their_template_cannot_be_rendered() -> None:
    server, cache = reconciled(config("a", x="${parameters.nothing}"))
    assert [each for each in server.written if each[1] == "ConfigMap"] == []
    record = cache.records[NAME]
    assert (record.applied.state.reason, record.digest) == ("RenderFailed", "before")
    assert [(each.name, each.uid) for each in record.applied.objects] == [("a", "uid-a")]
