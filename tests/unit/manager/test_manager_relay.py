"""Events of kopf's watches are relayed at once, and kopf sees their versions alone: around kopf's own functions."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any

import kopf
import pytest
from kopf._cogs.clients import api, watching

from application_manager.measures import Measures
from application_manager.watching.operator import relaying
from wayside.kubernetes.errors import Unreachable

RESOURCE = SimpleNamespace(plural="applicationtasks", get_url=lambda **_: "")
Event = tuple[str, str]


def answering(monkeypatch: pytest.MonkeyPatch, *events: Event) -> None:
    """Let kopf's API list one object of version 5, and then stream these events: type and name."""

    async def get(**_: Any) -> Any:
        listed = {"metadata": {"name": "listed", "resourceVersion": "3"}}
        return {"metadata": {"resourceVersion": "5", "continue": "more"}, "items": [listed]}

    async def stream(**_: Any) -> AsyncIterator[Any]:
        for version, (kind, name) in enumerate(events, start=6):
            yield {"type": kind, "object": {"metadata": {"name": name, "resourceVersion": str(version)}}}

    monkeypatch.setattr(api, "get", get)
    monkeypatch.setattr(api, "stream", stream)
    monkeypatch.setattr(kopf.OperatorSettings().watching.label_selectors.__class__, "collect", lambda *_: [])


async def watched(taken: list[Event], measures: Measures, *, unreachable: bool = False) -> list[Any]:
    """The events of a watch that kopf sees; relayed events go into `taken`."""

    def observe(raw: Any) -> None:
        taken.append(("there", raw["metadata"]["name"]))
        if raw["metadata"]["name"] == "faulty":
            raise ValueError("a defect")

    async def relist(resource: Any, namespace: str | None, labels: str) -> None:
        if unreachable:
            raise Unreachable("gone")
        taken.append(("listed", f"{resource.plural} in {namespace}"))

    resource: Any = RESOURCE
    stopper: Any = asyncio.get_running_loop().create_future()
    seen = []
    with relaying(observe, lambda raw: taken.append(("gone", raw["metadata"]["name"])), relist, measures.unhandled):
        async for each in watching.continuous_watch(
            settings=kopf.OperatorSettings(), resource=resource, namespace="town", operator_pause_waiter=stopper
        ):
            seen.append(each)
            if isinstance(each, dict) and each["object"]["metadata"]["resourceVersion"] == "9":
                stopper.set_result(None)
    return seen


def test_events_are_relayed_and_kopf_sees_versions_alone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    answering(monkeypatch, ("ADDED", "new"), ("MODIFIED", "faulty"), ("BOOKMARK", ""), ("DELETED", "old"))
    taken, measures = list[Event](), Measures()
    with caplog.at_level(logging.ERROR):
        seen = asyncio.run(watched(taken, measures))
    assert taken == [("listed", "applicationtasks in town"), ("there", "new"), ("there", "faulty"), ("gone", "old")]
    versions = [each["object"]["metadata"]["resourceVersion"] for each in seen if isinstance(each, dict)]
    assert versions == ["6", "7", "8", "9"]
    assert {each["type"] for each in seen if isinstance(each, dict)} == {"BOOKMARK"}
    assert "faulty; retrying at the next resync" in caplog.text
    assert b'reconcile_failures_total{queue="watch"} 1.0' in measures.text()


def test_a_list_that_fails_begins_the_watch_again(monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, ("ADDED", "new"))
    taken: list[Event] = []
    assert asyncio.run(watched(taken, Measures(), unreachable=True)) == []
    assert taken == []
