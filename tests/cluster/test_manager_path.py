"""From a task to a running workload and back, with the manager as a process and a real API server."""

from __future__ import annotations

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api
from tests.cluster.expected_objects import (
    condition,
    config,
    deployment,
    end,
    only_instance,
    start_manager,
    task,
    template,
    wait_settled,
)
from tests.cluster.pods import mark_pods_ready
from tests.cluster.processes import Process, Processes
from tests.cluster.waiting import wait_until

NORTH = instance_name("app", "north")


def test_a_task_becomes_a_deployment_that_is_ready_when_its_pods_are(api: Api, manager: Process) -> None:
    api.create(template())
    api.create(task("north"))
    api.wait_for("Deployment", NORTH, lambda _: True, what="the Deployment exists")
    waiting = api.wait_for(
        "ApplicationTask", "north", lambda raw: raw.get("status", {}).get("phase") == "Active", what="it is active"
    )
    assert condition(waiting, "Ready")["status"] == "False"
    api.wait_for(
        "ApplicationInstance",
        NORTH,
        lambda raw: "has 0 of 1 pods available" in condition(raw, "Ready").get("message", ""),
        what="the instance reports what it waits for",
    )

    wait_until(lambda: mark_pods_ready(api), bool, what="the pod exists")
    done = api.wait_for(
        "ApplicationTask", "north", lambda raw: raw.get("status", {}).get("phase") == "Ready", what="the task is ready"
    )
    assert {each["type"]: each["status"] for each in done["status"]["conditions"]} == {
        "Accepted": "True",
        "Applied": "True",
        "Ready": "True",
    }
    instance = api.wait_for(
        "ApplicationInstance", NORTH, lambda raw: raw["status"]["phase"] == "Ready", what="the instance is ready"
    )
    assert instance["status"]["demands"] == {"count": 1, "names": ["north"]}
    assert instance["status"]["observedGeneration"] == instance["metadata"]["generation"]
    wait_settled(api)


def test_after_its_demand_an_instance_lingers_and_is_deleted_with_its_objects(api: Api, manager: Process) -> None:
    api.create(template(linger="8s"))
    api.create(task("north"))
    api.wait_for("Deployment", NORTH, lambda _: True, what="the Deployment exists")
    end(api, "north")
    api.wait_for(
        "ApplicationInstance", NORTH, lambda raw: raw.get("status", {}).get("phase") == "Lingering", what="it lingers"
    )
    api.wait_gone("ApplicationInstance", NORTH)
    api.wait_gone("Deployment", NORTH)
    ended = api.wait_for(
        "ApplicationTask",
        "north",
        lambda raw: raw.get("status", {}).get("phase") == "Finished",
        what="the task is finished",
    )
    assert condition(ended, "Finished")["reason"] == "Ended"
    assert ended["status"]["instanceName"] == NORTH
    wait_settled(api)


def test_a_new_demand_within_the_linger_keeps_the_instance_untouched(api: Api, manager: Process) -> None:
    api.create(template(linger="300s"))
    api.create(task("north"))
    api.wait_for("Deployment", NORTH, lambda _: True, what="the Deployment exists")
    wait_settled(api)
    before = api.get("Deployment", NORTH)["metadata"]
    end(api, "north")
    api.wait_for(
        "ApplicationInstance", NORTH, lambda raw: "releaseTime" in raw.get("status", {}), what="the deadline is set"
    )
    api.create(task("again", region="north"))
    api.wait_for(
        "ApplicationInstance",
        NORTH,
        lambda raw: "releaseTime" not in raw.get("status", {}),
        what="the linger is cancelled",
    )
    wait_settled(api)
    after = api.get("Deployment", NORTH)["metadata"]
    assert (after["uid"], after["generation"]) == (before["uid"], before["generation"])


def test_the_last_parameter_value_is_removed_while_a_demand_without_values_remains(api: Api, manager: Process) -> None:
    optional = {"parameters": {"sources": {"type": "array", "items": "string", "merge": "Union"}}}
    name = instance_name("app", None)
    given = {"sources": ["car1"]}
    api.create({**template(), "spec": {"manifests": [deployment()], **optional}})
    for task_name, parameters in (("with", given), ("without", {})):
        spec = {"templateName": "app", "parameters": parameters}
        api.create({**task(task_name), "spec": spec})
    api.wait_for(
        "ApplicationInstance",
        name,
        lambda raw: raw["spec"].get("parameters") == {"sources": ["car1"]},
        what="it is there",
    )
    api.wait_for(
        "ApplicationTask", "without", lambda raw: raw.get("status", {}).get("instanceName") == name, what="both"
    )
    end(api, "with")
    api.wait_for(
        "ApplicationInstance", name, lambda raw: not raw["spec"].get("parameters"), what="the value is removed"
    )
    wait_settled(api)


def test_a_finished_task_is_deleted_after_its_time(processes: Processes, namespace: str, api: Api) -> None:
    start_manager(processes, namespace, "--ttl-after-finished", "1s")
    api.create(template())
    api.create(task("north"))
    end(api, "north")
    api.wait_gone("ApplicationTask", "north")


def test_two_pairs_at_one_place_share_an_instance_with_the_union_of_their_sources(api: Api, manager: Process) -> None:
    parameters = {"region": {"type": "string"}, "sources": {"type": "array", "items": "string", "merge": "Union"}}
    manifests = [deployment(), config({"sources": "${parameters.sources}!"})]
    api.create(template(parameters=parameters, manifests=manifests))
    api.create(task("one", region="north", sources=["car2", "car1"]))
    api.create(task("two", region="north", sources=["car3", "car2"]))
    api.wait_for(
        "ConfigMap",
        f"{NORTH}-config",
        lambda raw: raw["data"] == {"sources": '["car1","car2","car3"]!'},
        what="the sources are merged",
    )
    wait_settled(api)
    before = api.get("Deployment", NORTH)["metadata"]
    end(api, "two")
    api.wait_for(
        "ConfigMap",
        f"{NORTH}-config",
        lambda raw: raw["data"] == {"sources": '["car1","car2"]!'},
        what="the other sources remain",
    )
    wait_settled(api)
    assert api.get("Deployment", NORTH)["metadata"]["generation"] == before["generation"]


def test_a_manually_created_instance_is_applied_but_never_released(api: Api, manager: Process) -> None:
    api.create(template())
    api.create(
        {
            "apiVersion": "wayside.dev/v1alpha1",
            "kind": "ApplicationInstance",
            "metadata": {"name": "trial"},
            "spec": {"templateName": "app", "key": "trial", "parameters": {"region": "trial"}},
        }
    )
    api.wait_for("Deployment", "trial", lambda _: True, what="the Deployment exists")
    api.create(task("north"))
    api.wait_for("Deployment", NORTH, lambda _: True, what="the other Deployment exists")
    end(api, "north")
    api.wait_gone("ApplicationInstance", NORTH)
    assert "releaseTime" not in api.get("ApplicationInstance", "trial")["status"]
    api.delete("ApplicationInstance", "trial")
    api.wait_gone("Deployment", "trial")
    wait_settled(api)


def test_events_report_each_change_once(api: Api, manager: Process) -> None:
    api.create(template())
    api.wait_for("ApplicationTemplate", "app", lambda raw: bool(condition(raw, "Accepted")), what="it is known")
    api.create(task("north"))
    api.create({**task("wrong"), "spec": {"templateName": "nowhere"}})
    api.wait_for("Deployment", NORTH, lambda _: True, what="the Deployment exists")

    def reported() -> list[tuple[str, str, str]]:
        return sorted(
            (each["regarding"]["kind"], each["regarding"]["name"], each["reason"])
            for each in api.list("Event.events.k8s.io")
            if each["reportingController"] == "wayside.dev/application-manager"
        )

    expected = [
        ("ApplicationInstance", NORTH, "Applied"),
        ("ApplicationTask", "wrong", "Refused"),
        ("ApplicationTemplate", "app", "Accepted"),
    ]
    wait_until(reported, lambda found: found == expected, what="the Events are posted")
    manager.restart()
    manager.wait_for_output("watching")
    wait_settled(api)
    assert only_instance(api)["status"]["phase"] == "Applied"
    assert reported() == expected
