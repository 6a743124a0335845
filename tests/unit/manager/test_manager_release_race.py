"""An instance that goes while its release is being checked is not made again by it."""

from __future__ import annotations

import asyncio
from typing import Any, cast

from application_manager.cluster.apply import Applier
from application_manager.cluster.client import Client, Resource
from application_manager.cluster.store import Entry, Name
from application_manager.core.objects.policy import Policy
from application_manager.knowledge.world import INSTANCE, World
from application_manager.work.instances import InstanceWork
from application_manager.work.recorder import Recorder
from application_manager.work.suspending import Suspending
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.api.base import API_VERSION

NAME = ("site", "app-0000000000")
KEYED = {"key": "${parameters.place}", "parameters": {"place": {"type": "string"}}}


class GoingServer:
    """An API server on which the instance goes just while the tasks are listed; everything written is noted."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.written: list[Any] = []

    async def list(self, *_: object, **__: object) -> tuple[list[Any], str]:
        entry = self.world.store.get(INSTANCE, NAME)
        assert entry is not None
        self.world.store.remove(entry.raw)
        return [], "9"

    async def apply(self, resource: Resource, body: Any) -> Any:
        self.written.append(body)
        return body

    async def delete(self, *of: object) -> None:
        self.written.append(of)


def test_an_instance_that_goes_while_its_release_is_checked_stays_gone_while_its_holder_is_lost() -> None:
    world = World(Policy())
    for version, model in enumerate((template(**KEYED), instance(NAME[1], key="west", release_at=NOW - 1e8)), start=1):
        raw = {"apiVersion": API_VERSION, **model.to_json()}
        raw["metadata"] = {**raw["metadata"], "uid": f"uid-{version}", "resourceVersion": str(version)}
        assert world.store.put(raw) is not None
    lost = task("a", {"place": "west"}, holder="town", accepted_condition=("False", "HolderLost", NOW - 100))
    world.claims.note(("site", "a"), Entry(lost.to_json(), lost), world.template(("site", "app")))
    server = GoingServer(world)
    client = cast("Client", server)
    absent: list[Name] = []
    applier, instances = Applier(client, world.store, {}), Resource(API_VERSION, "ApplicationInstance", "instances")
    work = InstanceWork(
        world=world,
        client=client,
        applier=applier,
        recorder=Recorder(client),
        suspending=Suspending(client, applier, instances, lambda raw: None),
        instances=instances,
        tasks=Resource(API_VERSION, "ApplicationTask", "applicationtasks"),
        again=lambda name, at: None,
        done=lambda name: None,
        absent=lambda name, decision: absent.append(name),
        observe=lambda raw: None,
        configured=lambda name: None,
    )
    asyncio.run(work.reconcile(NAME))
    assert server.written == []
    assert absent == [NAME]
