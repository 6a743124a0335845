"""Objects that are too large are rejected or not cached, and a manager near its memory limit accepts no more tasks."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, ApiError, Object
from tests.cluster.expected_objects import condition, start_manager, task, template, wait_settled
from tests.cluster.processes import Process, Processes

MIB = 1024 * 1024
MANY, VALUES, ITEMS = 20, 28, 4000
"""The number of tasks, of their values and of the items in each: the API server accepts at most 4,096 items."""

GROWTH = 70 * MIB
"""The memory that these tasks of 1 MB may take. With all values in memory, they take at least 140 MiB."""


def event(values: dict[str, Any]) -> dict[str, Any]:
    at = "2026-01-01T00:00:00Z"
    return {
        "id": "e",
        "rule": "r",
        "action": "a",
        "subject": "s",
        "onsetTime": at,
        "startTime": at,
        "values": values,
    }


def with_spec(made: Object, **fields: Any) -> Object:
    return {**made, "spec": {**made["spec"], **fields}}


def test_the_api_server_rejects_values_that_are_too_large_by_field(api: Api) -> None:
    for field, made in (
        ("spec.event.values.x", with_spec(task("text"), event=event({"x": "x" * 900_000}))),
        ("spec.event.values.x", with_spec(task("list"), event=event({"x": list(range(100_000))}))),
        ("spec.parameters.x", with_spec(task("parameter"), parameters={"x": "x" * 900_000})),
    ):
        with pytest.raises(ApiError, match=r"[Tt]oo (long|many)") as refused:
            api.create(made)
        assert field in str(refused.value)


def test_tasks_of_a_megabyte_take_little_memory(api: Api, manager: Process) -> None:
    api.create(template())
    api.create(task("first"))
    wait_settled(api)
    before = manager.resident_bytes()
    for number in range(MANY):
        values = {f"x{index}": [f"v{item:05}" for item in range(ITEMS)] for index in range(VALUES)}
        api.create(with_spec(task(f"large-{number}"), event=event(values)))
    wait_settled(api)
    assert manager.resident_bytes() - before < GROWTH


def test_parameters_and_templates_that_are_too_large_are_rejected_with_their_size(api: Api, manager: Process) -> None:
    api.create(template())
    large = template("large", configuration={f"data{index}.txt": "x" * 60_000 for index in range(5)})
    api.create(large)
    reported = api.wait_for(
        "ApplicationTemplate", "large", lambda raw: bool(condition(raw, "Accepted")), what="it has a status"
    )
    assert condition(reported, "Accepted")["status"] == "False"
    assert "at most 262144" in condition(reported, "Accepted")["message"]
    api.create(task("parameters", **{f"p{index}": "x" * 60_000 for index in range(3)}))
    refused = api.wait_for(
        "ApplicationTask", "parameters", lambda raw: bool(condition(raw, "Accepted")), what="it has a status"
    )
    assert "more than the 65536 allowed" in condition(refused, "Accepted")["message"]
    api.create(task("north"))
    api.wait_for("Deployment", instance_name("app", "north"), lambda _: True, what="others are served")


def test_near_its_memory_limit_the_manager_serves_known_tasks_and_lets_new_ones_wait(
    api: Api, processes: Processes, namespace: str
) -> None:
    roomy = start_manager(processes, namespace)
    api.create(template())
    api.create(task("north"))
    wait_settled(api)
    before = api.get("Deployment", instance_name("app", "north"))["metadata"]
    roomy.terminate()

    tight = start_manager(processes, namespace, "--memory-limit", "1Mi")
    api.create(task("south"))
    waiting = api.wait_for(
        "ApplicationTask",
        "south",
        lambda raw: condition(raw, "Accepted").get("reason") == "ManagerOverloaded",
        what="it is not admitted, and reports it",
    )
    assert waiting["status"]["phase"] == "Waiting"
    assert "memory limit" in condition(waiting, "Accepted")["message"]
    assert "not accepting new tasks" in tight.output()
    assert api.get("Deployment", instance_name("app", "north"))["metadata"]["uid"] == before["uid"]
    assert api.find("Deployment", instance_name("app", "south")) is None
    tight.terminate()

    start_manager(processes, namespace)
    wait_settled(api)
    assert api.find("Deployment", instance_name("app", "south")) is not None
