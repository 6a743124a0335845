"""Kubernetes Events that are dropped are reported at once, then once a minute, with a count."""

from __future__ import annotations

import asyncio
import logging
from typing import Any, cast

import pytest

from application_manager.work import recorder
from application_manager.work.recorder import EventReason, Recorder
from tests.patience import PATIENCE
from tests.unit.manager_objects import NOW, task
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError


class RejectingServer:
    """An API server that rejects Events."""

    def __init__(self) -> None:
        self.requested = 0

    async def create(self, *_: Any) -> None:
        self.requested += 1
        raise ApiError(403, "events are forbidden")


def report(events: Recorder, first: int, count: int) -> None:
    for each in range(first, first + count):
        about = task(f"t{each}")
        about = about.model_copy(update={"metadata": about.metadata.model_copy(update={"uid": f"u{each}"})})
        events.event(about, EventReason.ACCEPTED, "counts", NOW)


class AcceptingServer:
    """An API server that accepts Events and records their namespaces."""

    def __init__(self) -> None:
        self.namespaces: list[str] = []

    async def create(self, _: Any, manifest: Any) -> None:
        self.namespaces.append(manifest["metadata"]["namespace"])


def test_namespaces_take_turns() -> None:
    server = AcceptingServer()
    events = Recorder(cast("Client", server))

    async def flood() -> None:
        report(events, 0, 100)
        one = task("one")
        quiet = one.metadata.model_copy(update={"namespace": "quiet", "uid": "quiet"})
        events.event(one.model_copy(update={"metadata": quiet}), EventReason.ACCEPTED, "counts", NOW)
        events.finish()
        await events.run()

    asyncio.run(flood())
    assert len(server.namespaces) == 101
    assert server.namespaces.index("quiet") == 1


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [each.getMessage() for each in caplog.records if " Events since" in each.getMessage()]


def test_thousands_of_dropped_events_are_two_log_lines_with_their_count(caplog: pytest.LogCaptureFixture) -> None:
    server = RejectingServer()
    events = Recorder(cast("Client", server))

    async def flood() -> None:
        report(events, 0, 3135)
        events.finish()
        await events.run()

    with caplog.at_level(logging.WARNING):
        asyncio.run(flood())
    assert server.requested == 1000
    first, last = lines(caplog)
    assert first.startswith("dropped 2136 Events since the last report; the last one: Accepted about t0: ")
    assert last.startswith("dropped 999 Events since the last report; the last one: Accepted about t999: ")


def test_later_drops_are_reported_after_a_minute_without_a_further_event(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "_REPORT_EVERY", 1.0)  # the five are dropped within that
    events = Recorder(cast("Client", RejectingServer()))

    async def trickle() -> None:
        running = asyncio.create_task(events.run())
        report(events, 0, 5)
        async with asyncio.timeout(PATIENCE):
            while len(lines(caplog)) < 2:  # noqa: ASYNC110  a log has no event to wait for
                await asyncio.sleep(0.01)
        running.cancel()

    with caplog.at_level(logging.WARNING):
        asyncio.run(trickle())
    assert [each.split()[1] for each in lines(caplog)] == ["1", "4"]
