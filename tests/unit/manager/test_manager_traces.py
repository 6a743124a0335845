"""A task that ends before its status has its instance still has a failed `ready` in its trace."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import cast

import pytest

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.cache.store import Entry
from application_manager.measures import Measures
from application_manager.work.recorder import Recorder
from application_manager.work.statuses import StatusWriter
from application_manager.work.tasks import TaskWork
from application_manager.work.tracing import TaskTraces
from tests.otlp import Received, Receiver
from tests.unit.manager.memory_server import CONFIG_MAPS, MemoryServer, a_cache, raw, work_on
from tests.unit.manager_objects import task, template
from wayside.api import ApplicationTask
from wayside.kubernetes.client import Client
from wayside.kubernetes.resources import Object, Resource
from wayside.process.tracing import tracing

APP, TASK = ("site", "app"), ("site", "t")
CONFIG = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "a"}}
TRACED = {"wayside.dev/traceparent": f"00-{7:032x}-{7:016x}-01"}


class Server(MemoryServer):
    """An API server on which something happens while a ConfigMap is applied."""

    async def meanwhile(self) -> None:
        """Nothing, by default."""

    async def apply(self, resource: Resource, body: Object) -> Object:
        if resource is CONFIG_MAPS:
            await self.meanwhile()
        return await super().apply(resource, body)


def traced(*, ended: bool) -> ApplicationTask:
    made = task("t", ended=ended)
    metadata = made.metadata.model_copy(update={"uid": "uid-t", "annotations": TRACED})
    return made.model_copy(update={"metadata": metadata})


Run = Callable[[TaskTraces, ClusterCache, Server, Callable[[], Awaitable[None]]], Awaitable[None]]


def spans(monkeypatch: pytest.MonkeyPatch, run: Run) -> dict[str, Received]:
    """The spans of a run, by name; it is given what ends the task and writes that into the task's status."""
    with Receiver() as receiver:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", receiver.endpoint)
        exporting = tracing("manager")
        assert exporting is not None

        async def whole() -> None:
            server = Server(raw(traced(ended=False), 1))
            cache = a_cache(
                server.put(raw(template(manifests=[CONFIG]), 2)),
                server.objects["ApplicationTask", "t"],
                task=traced(ended=False),
            )
            traces = TaskTraces(exporting, cache)
            client = cast("Client", server)
            work = TaskWork(
                cache=cache,
                client=client,
                statuses=StatusWriter(client, Recorder(client), cache.store.put),
                ttl=60,
                enqueue_at=lambda name, at: None,
                observe=cache.store.put,
                measures=Measures(),
                traces=traces,
            )

            async def end() -> None:
                over = traced(ended=True)
                cache.store.put(server.put(raw(over, 3)))
                cache.claims.note(TASK, Entry(over.to_json(), over), cache.template(APP))
                await work.reconcile(TASK)

            await run(traces, cache, server, end)

        asyncio.run(whole())
        exporting.close()
        found = receiver.spans()
    assert len({each.name for each in found}) == len(found)
    return {each.name: each for each in found}


def failed(found: dict[str, Received]) -> None:
    assert found.keys() == {"reconcile app", "apply", "ready"}
    ready, reconciled = found["ready"], found["reconcile app"]
    assert ready.error == "NotReady: the task ended before its instance was ready"
    assert (ready.parent, ready.attributes["wayside.instance"]) == (reconciled.id, "app")
    assert found["apply"].error is reconciled.error is None


def test_a_task_that_ends_before_its_status_reports_that_it_is_applied_was_never_ready(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def run(traces: TaskTraces, cache: ClusterCache, server: Server, end: Callable[[], Awaitable[None]]) -> None:
        await traces.reconciling(APP, work_on(cache, server, []).reconcile)
        await end()

    failed(spans(monkeypatch, run))


def test_a_task_that_ends_while_its_instance_is_applied_was_never_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run(traces: TaskTraces, cache: ClusterCache, server: Server, end: Callable[[], Awaitable[None]]) -> None:
        server.meanwhile = end  # type: ignore[method-assign,assignment]
        await traces.reconciling(APP, work_on(cache, server, []).reconcile)

    failed(spans(monkeypatch, run))
