"""The manager's Prometheus metrics, each of which the guide describes."""

from __future__ import annotations

import asyncio
import re
from types import SimpleNamespace
from typing import Any, cast

import aiohttp
import pytest
from prometheus_client.parser import text_string_to_metric_families

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.core.objects.policy import Policy
from application_manager.measures import PREFIX, Measures
from application_manager.observability.overview import Overview
from application_manager.observability.pages import STALLED_AFTER, pages, stalled
from application_manager.running.headroom import Headroom
from application_manager.watching.watch_health import WatchHealth
from application_manager.work.recorder import BURST, REFILL, EventReason, TokenBuckets
from application_manager.work.tracing import LostSpans
from tests.guides import guide
from tests.patience import PATIENCE
from tests.unit.manager_objects import instance, task, template
from wayside.kubernetes.connection import ConfigurationError
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.workqueue import WorkQueue
from wayside.process.spans import Tracing

GUIDE = guide("manager")


def raw(model: Any, version: int = 1, **status: Any) -> dict[str, Any]:
    made: dict[str, Any] = model.to_json()
    made["metadata"] |= {"uid": f"uid-{made['kind']}-{model.name}", "resourceVersion": str(version)}
    return made | ({"status": status} if status else {})


def samples(measures: Measures) -> dict[tuple[str, ...], float]:
    """By name without prefix and the values of the labels in order of their names."""
    return {
        (sample.name.removeprefix(PREFIX), *(sample.labels[key] for key in sorted(sample.labels))): sample.value
        for family in text_string_to_metric_families(measures.text().decode())
        for sample in family.samples
    }


def test_tasks_instances_and_templates_are_counted_by_state() -> None:
    cache, measures = ClusterCache(Policy()), Measures()
    measures.registry.register(Overview(cache, lambda: [("task", 3, 1)]))
    cache.store.put(raw(task("a"), phase="Ready"))
    cache.store.put(raw(task("b"), phase="Ready"))
    cache.store.put(raw(task("c")))
    cache.store.put(raw(instance(), phase="Lingering"))
    accepted = {
        "type": "Accepted",
        "status": "True",
        "reason": "Accepted",
        "lastTransitionTime": "2026-01-01T00:00:00Z",
    }
    cache.store.put(raw(template(), conditions=[accepted]))
    found = samples(measures)
    assert (found["tasks", "Ready"], found["tasks", "None"], found["tasks", "Refused"]) == (2, 1, 0)
    assert (found["instances", "Lingering"], found["templates", "True"]) == (1, 1)
    assert (found["queue_depth", "task"], found["queue_later", "task"]) == (3, 1)
    assert found["api_reached",] == 0


def test_requests_events_and_times_are_counted() -> None:
    measures = Measures()
    measures.requested("GET", 0.03, "200")
    measures.requested("PATCH", 0.03, "409")
    measures.applied(0.3)
    measures.ready(-5)  # the detector's clock is ahead of ours
    measures.refused("Conflict")
    found = samples(measures)
    assert found["api_request_seconds_count", "GET"] == 1
    assert found["api_errors_total", "409"] == 1
    assert ("api_errors_total", "200") not in found
    assert (found["event_to_applied_seconds_bucket", "0.2"], found["event_to_applied_seconds_bucket", "0.5"]) == (0, 1)
    assert found["event_to_ready_seconds_bucket", "0.05"] == 1
    assert found["refusals_total", "Conflict"] == 1


def test_a_queue_reports_durations_and_failures() -> None:
    measures, failures = Measures(), [ApiError(503, "busy")]

    async def scenario() -> None:
        finished = asyncio.Event()

        async def work(key: str) -> None:
            if failures:
                raise failures.pop()
            if key == "a":
                queue.add("b")
            else:
                finished.set()

        queue = WorkQueue("task", work, 1, measure=measures.reconciled)
        queue.add("a")
        running = asyncio.create_task(queue.run())
        async with asyncio.timeout(PATIENCE):
            await finished.wait()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    asyncio.run(scenario())
    found = samples(measures)
    assert found["reconcile_failures_total", "task"] == 1
    assert found["reconcile_seconds_count", "task"] >= 2


def test_pages_are_served_with_503_while_not_ready() -> None:
    async def scenario() -> None:
        lacks: list[str] = ["not yet"]
        measures = Measures()
        async with pages(0, measures, stalled(measures, 60), lambda: lacks[0] if lacks else None) as port:
            async with aiohttp.ClientSession() as session:

                async def get(path: str) -> tuple[int, str]:
                    async with session.get(f"http://127.0.0.1:{port}{path}") as answer:
                        return answer.status, await answer.text()

                assert f"{PREFIX}api_request_seconds" in (await get("/metrics"))[1]
                assert await get("/healthz") == (200, "ok\n")
                assert await get("/readyz") == (503, "not yet\n")
                lacks.clear()
                assert await get("/readyz") == (200, "ok\n")
                measures.last_resync -= STALLED_AFTER + 1
                status, text = await get("/healthz")
                assert (status, text.startswith("no resync has completed for 30")) == (503, True)
            with pytest.raises(ConfigurationError, match=rf"--metrics-port {port}: .*: give another port"):
                async with pages(port, measures, lambda: None, lambda: None):
                    pass

    asyncio.run(scenario())


def test_a_frequently_changing_object_is_reported_at_a_limited_rate() -> None:
    buckets = TokenBuckets()
    assert [buckets.take("a", 0.0) for _ in range(BURST + 2)] == [True] * BURST + [False] * 2
    assert buckets.take("b", 0.0)
    assert not buckets.take("a", REFILL - 1)
    assert buckets.take("a", REFILL + 1)
    assert not buckets.take("a", REFILL + 2)


def test_the_guide_describes_every_metric() -> None:
    measures = Measures()
    measures.registry.register(Overview(ClusterCache(Policy()), list))
    measures.registry.register(LostSpans(cast("Tracing", SimpleNamespace(dropped=0, failed=0))))
    measures.registry.register(WatchHealth(90, lambda: 0.0))
    measures.registry.register(Headroom(1))
    names = {each.name + ("_total" if each.type == "counter" else "") for each in measures.registry.collect()}
    own = {each.removeprefix(PREFIX) for each in names if each.startswith(PREFIX)}
    assert len(own) > 12
    assert {each for each in own if f"`{each}`" not in GUIDE} == set()
    described = set(re.findall(r"^\| `([a-z_]+)` \|", GUIDE[GUIDE.index("## Metrics") :], re.MULTILINE))
    assert described - own == set()


def test_the_guide_lists_every_reason_of_an_event() -> None:
    assert {each.value for each in EventReason if f"`{each.value}`" not in GUIDE} == set()
