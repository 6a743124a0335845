"""Manual annotations on instances: pause stops changes, hold keeps an instance, and its status shows both."""

from __future__ import annotations

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import condition, end, task, template, wait_settled
from tests.cluster.processes import Process

NORTH = instance_name("app", "north")
SCALED = {
    "parameters": {"region": {"type": "string"}, "zones": {"type": "array", "items": "string", "merge": "Union"}},
    "manifests": [
        {
            "apiVersion": "v1",
            "kind": "ConfigMap",
            "metadata": {"name": "${instance.name}"},
            "data": {"z": "${parameters.zones}!"},
        }
    ],
}


def annotate(api: Api, annotation: str, value: str | None) -> None:
    metadata = {"annotations": {f"wayside.dev/{annotation}": value}}
    api.patch("ApplicationInstance", NORTH, {"metadata": metadata})


def wait_condition(api: Api, type_: str, status: str, kind: str = "ApplicationInstance", name: str = NORTH) -> Object:
    return api.wait_for(
        kind, name, lambda raw: condition(raw, type_).get("status") == status, what=f"{type_} is {status}"
    )


def test_a_paused_instance_is_not_changed_until_the_annotation_is_removed(api: Api, manager: Process) -> None:
    api.create(template(**SCALED))
    api.create(task("one", region="north", zones=["a"]))
    api.wait_for("ConfigMap", NORTH, lambda raw: raw["data"]["z"] == '["a"]!', what="it runs")
    wait_settled(api)
    annotate(api, "pause", "anna looks at a fault")
    paused = wait_condition(api, "Paused", "True")
    assert "anna looks at a fault" in condition(paused, "Paused")["message"]

    api.create(task("two", region="north", zones=["b"]))
    waiting = api.wait_for(
        "ApplicationTask",
        "two",
        lambda raw: "is paused" in condition(raw, "Applied").get("message", ""),
        what="it waits",
    )
    assert condition(waiting, "Accepted")["status"] == "True"
    api.patch("ConfigMap", NORTH, {"data": {"z": "by hand"}})
    end(api, "one")
    end(api, "two")
    api.wait_for(
        "ApplicationInstance", NORTH, lambda raw: raw["status"]["demands"]["count"] == 0, what="all demands have ended"
    )
    manager.restart()
    manager.wait_for_output("watching")
    wait_settled(api)
    assert api.get("ConfigMap", NORTH)["data"]["z"] == "by hand"
    assert "releaseTime" not in api.get("ApplicationInstance", NORTH)["status"]

    api.create(task("three", region="north", zones=["c"]))
    annotate(api, "pause", None)
    api.wait_for("ConfigMap", NORTH, lambda raw: raw["data"]["z"] == '["c"]!', what="the values are applied again")
    wait_condition(api, "Paused", "False")
    wait_condition(api, "Applied", "True", "ApplicationTask", "three")
    wait_settled(api)


def test_a_held_instance_keeps_running_without_demand(api: Api, manager: Process) -> None:
    api.create(template(linger="1s"))
    api.create(task("north"))
    api.wait_for("Deployment", NORTH, lambda _: True, what="it runs")
    annotate(api, "hold", "true")
    wait_condition(api, "Held", "True")
    end(api, "north")
    api.wait_for(
        "ApplicationInstance", NORTH, lambda raw: raw["status"]["demands"]["count"] == 0, what="all demands have ended"
    )
    manager.restart()
    manager.wait_for_output("watching")
    wait_settled(api)
    held = api.get("ApplicationInstance", NORTH)
    assert "releaseTime" not in held["status"]
    assert held["status"]["phase"] == "Applied"
    annotate(api, "hold", None)
    api.wait_gone("ApplicationInstance", NORTH)
    api.wait_gone("Deployment", NORTH)
