"""kopf's watches report activity, and a silent watch is restarted: a wrapper of kopf's function."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any

import kopf
import pytest
from kopf._cogs.clients import api, watching

from application_manager.watching.watch_health import NEVER, WatchHealth, supervising

TASKS = SimpleNamespace(plural="applicationtasks", get_url=lambda **_: "")


def streaming(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Let kopf's API return `events` events, and then nothing."""

    async def stream(**_: Any) -> AsyncIterator[Any]:
        for version in range(count):
            yield {"type": "ADDED", "object": {"metadata": {"resourceVersion": str(version)}}}
        await asyncio.Event().wait()

    monkeypatch.setattr(api, "stream", stream)
    monkeypatch.setattr(kopf.OperatorSettings().watching.label_selectors.__class__, "collect", lambda *_: [])


async def read(settings: kopf.OperatorSettings, pause: float) -> int:
    """Read a watch until it ends, pausing after each event; how many came."""
    count = 0
    resource: Any = TASKS
    stopper: Any = asyncio.get_running_loop().create_future()
    async for _ in watching.watch_objs(
        settings=settings, resource=resource, namespace="town", operator_pause_waiter=stopper
    ):
        count += 1
        await asyncio.sleep(pause)
    return count


def test_our_watch_timeout_does_not_cancel_the_reader_as_kopfs_does(monkeypatch: pytest.MonkeyPatch) -> None:
    async def kopfs() -> int:
        settings = kopf.OperatorSettings()
        settings.watching.inactivity_timeout = 0.01
        return await asyncio.create_task(read(settings, 0.1))

    async def ours() -> tuple[int, WatchHealth]:
        settings = kopf.OperatorSettings()
        settings.watching.inactivity_timeout = NEVER
        health = WatchHealth(0.05, lambda: 0.0)
        with supervising(health):
            return await asyncio.create_task(read(settings, 0.1)), health

    streaming(monkeypatch, 3)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(kopfs())
    count, health = asyncio.run(ours())
    assert count == 3
    assert health.dead() is None
    samples = {each.name: each.samples for each in health.collect()}
    assert [each.labels for each in samples["wayside_manager_watch_age_seconds"]] == [{"resource": "applicationtasks"}]
    assert [each.value for each in samples["wayside_manager_watch_restarts"]] == [1]


def test_only_time_in_which_the_api_server_answers_counts_against_a_watch() -> None:
    healthy = [0.0]
    health = WatchHealth(90, lambda: healthy[0])
    health.beat(("applicationtasks", "town"))
    healthy[0] = 180
    assert health.dead() is None
    healthy[0] = 181
    assert health.dead() == "the watch of applicationtasks has had neither events nor bookmarks for 181 s"
    health.forget(("applicationtasks", "town"))
    assert health.dead() is None
