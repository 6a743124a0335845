"""An instance that is deleted during its release check is not recreated."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

from application_manager.cache.cluster_cache import INSTANCE, ClusterCache
from application_manager.core.objects.policy import Name
from tests.unit.manager.memory_server import a_cache, raw, work_on
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.kubernetes.resources import Resource

NAME = ("site", "app-0000000000")
KEYED = {"key": "${parameters.place}", "parameters": {"place": {"type": "string"}}}


class GoingServer:
    """An API server that deletes the instance while the tasks are listed; it records all writes."""

    def __init__(self, cache: ClusterCache) -> None:
        self.cache = cache
        self.written: list[Any] = []

    async def pages(self, *_: object, **__: object) -> AsyncIterator[tuple[list[Any], str]]:
        entry = self.cache.store.get(INSTANCE, NAME)
        assert entry is not None
        self.cache.store.remove(entry.raw)
        yield [], "9"

    async def apply(self, resource: Resource, body: Any) -> Any:
        self.written.append(body)
        return body

    async def delete(self, *of: object) -> None:
        self.written.append(of)


def test_an_instance_deleted_during_its_release_check_is_not_recreated() -> None:
    lost = task("a", {"place": "west"}, holder="town", accepted_condition=("False", "HolderLost", NOW - 100))
    going = instance(NAME[1], key="west", release_at=NOW - 1e8)
    cache = a_cache(raw(template(**KEYED), 1), raw(going, 2), task=lost)
    server = GoingServer(cache)
    absent: list[Name] = []
    asyncio.run(work_on(cache, server, absent).reconcile(NAME))
    assert server.written == []
    assert absent == [NAME]
