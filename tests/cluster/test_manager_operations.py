"""Reconfigure and Suspend on a real control plane, also with a manager that is killed in the middle of it."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import (
    condition,
    config,
    deployment,
    end,
    task,
    template,
    wait_settled,
)
from tests.cluster.processes import Process

NORTH, SOUTH = instance_name("app", "north"), instance_name("app", "south")
PARAMETERS = {
    "region": {"type": "string", "required": True},
    "rate": {"type": "number", "default": 10, "merge": "Max"},
}


def rated(**spec: Any) -> Object:
    """A template whose ConfigMap shows the rate."""
    return template(parameters=PARAMETERS, manifests=[deployment(), config({"rate": "${parameters.rate} Hz"})], **spec)


def freely_scaled(**spec: Any) -> Object:
    """A template that does not set the number of replicas."""
    manifest = deployment()
    del manifest["spec"]["replicas"]
    return template(manifests=[manifest], **spec)


def acting(operation: str, name: str, priority: int = 0, **parameters: Any) -> Object:
    made = task(name)
    made["spec"] |= {"operation": operation, "priority": priority, "parameters": parameters}
    return made


def wait_rate(api: Api, name: str, rate: int) -> None:
    expected = {"rate": f"{rate} Hz"}
    api.wait_for("ConfigMap", f"{name}-config", lambda raw: raw["data"] == expected, what=f"{name} has rate {rate}")


def wait_replicas(api: Api, name: str, replicas: int) -> Object:
    return api.wait_for(
        "Deployment",
        name,
        lambda raw: raw["spec"]["replicas"] == raw.get("status", {}).get("replicas", 0) == replicas,
        what=f"{name} has {replicas} replicas",
    )


def wait_phase(api: Api, name: str, phase: str) -> Object:
    return api.wait_for(
        "ApplicationTask", name, lambda raw: raw.get("status", {}).get("phase") == phase, what=f"{name} is {phase}"
    )


def wait_suspended(api: Api, name: str, status: str) -> Object:
    return api.wait_for(
        "ApplicationInstance",
        name,
        lambda raw: condition(raw, "Suspended").get("status") == status,
        what=f"the instance's Suspended is {status}",
    )


def scale(api: Api, name: str, replicas: int) -> None:
    """As `kubectl scale` does, or an autoscaler."""
    api.patch("Deployment", name, {"spec": {"replicas": replicas}}, subresource="scale")


def test_a_reconfiguration_waits_overrides_the_values_and_is_reverted(api: Api, manager: Process) -> None:
    api.create(rated())
    api.create(acting("Reconfigure", "slow", region="north", rate=2))
    waiting = wait_phase(api, "slow", "Waiting")
    assert condition(waiting, "Accepted")["reason"] == "NothingRuns"
    assert api.list("ApplicationInstance") == []

    api.create(task("a", region="north", rate=20))
    wait_rate(api, NORTH, 2)
    wait_settled(api)
    before = api.get("Deployment", NORTH)["metadata"]
    api.create(task("b", region="north", rate=30))
    manager.kill9()
    end(api, "slow")
    manager.start()
    wait_rate(api, NORTH, 30)
    wait_phase(api, "slow", "Finished")
    wait_settled(api)
    assert api.get("Deployment", NORTH)["metadata"]["generation"] == before["generation"]  # no rollout happened


def test_a_reconfiguration_without_a_key_covers_existing_and_new_instances(api: Api, manager: Process) -> None:
    api.create(rated())
    api.create(task("north"))
    api.create(acting("Reconfigure", "slow", rate=2))
    wait_rate(api, NORTH, 2)
    api.create(task("south"))
    wait_rate(api, SOUTH, 2)
    both = ", ".join(sorted((NORTH, SOUTH)))
    api.wait_for(
        "ApplicationTask",
        "slow",
        lambda raw: condition(raw, "Accepted").get("message") == f"reconfigures instances {both}",
        what="the task names both",
    )
    end(api, "north")
    end(api, "south")
    api.wait_gone("ApplicationInstance", NORTH)
    api.wait_gone("ApplicationInstance", SOUTH)
    wait_phase(api, "slow", "Waiting")
    wait_settled(api)


def test_a_suspended_instance_has_zero_replicas_and_resumes_with_its_former_number(api: Api, manager: Process) -> None:
    api.create(freely_scaled())
    api.create(task("north"))
    wait_replicas(api, NORTH, 1)
    wait_settled(api)
    scale(api, NORTH, 3)
    wait_replicas(api, NORTH, 3)
    api.create(acting("Suspend", "night"))
    wait_replicas(api, NORTH, 0)
    instance = wait_suspended(api, NORTH, "True")
    (noted,) = instance["status"]["suspendedReplicas"]
    assert (noted["kind"], noted["name"], noted["replicas"]) == ("Deployment", NORTH, 3)
    assert instance["status"]["phase"] == "Suspended"
    assert condition(instance, "Ready")["reason"] == "Suspended"
    wait_phase(api, "north", "Suspended")
    wait_phase(api, "night", "Ready")
    wait_settled(api)

    scale(api, NORTH, 2)  # a user starts it manually
    wait_replicas(api, NORTH, 0)
    end(api, "night")
    wait_replicas(api, NORTH, 3)
    wait_suspended(api, NORTH, "False")
    api.wait_for(
        "ApplicationInstance", NORTH, lambda raw: not raw["status"].get("suspendedReplicas"), what="nothing is noted"
    )
    wait_settled(api)


def test_an_outranked_suspension_reports_it_and_applies_when_the_higher_priority_ends(
    api: Api, manager: Process
) -> None:
    api.create(template())
    first = task("important", region="north")
    first["spec"]["priority"] = 5
    api.create(first)
    api.create(task("usual", region="north"))
    api.create(acting("Suspend", "night", region="north", priority=1))
    outbid = wait_phase(api, "night", "Refused")
    assert condition(outbid, "Accepted")["reason"] == "Outbid"
    wait_replicas(api, NORTH, 1)
    end(api, "important")
    wait_replicas(api, NORTH, 0)
    wait_settled(api)


def test_an_instance_created_while_suspended_never_has_a_pod(api: Api, manager: Process) -> None:
    api.create(template())
    api.create(acting("Suspend", "night"))
    wait_phase(api, "night", "Waiting")
    api.create(task("north"))
    wait_suspended(api, NORTH, "True")
    assert api.get("Deployment", NORTH)["metadata"]["generation"] == 1  # its number of replicas never changed
    end(api, "night")
    wait_replicas(api, NORTH, 1)
    wait_settled(api)


@pytest.mark.parametrize("moment", ["wanted", "noted", "at zero"])
def test_a_manager_killed_while_it_suspends_or_resumes_loses_no_replicas(
    api: Api, manager: Process, moment: str
) -> None:
    api.create(freely_scaled())
    api.create(task("north"))
    wait_replicas(api, NORTH, 1)
    wait_settled(api)
    scale(api, NORTH, 4)
    wait_replicas(api, NORTH, 4)
    api.create(acting("Suspend", "night"))
    reached = {
        "wanted": lambda raw: raw["spec"].get("suspended"),
        "noted": lambda raw: raw.get("status", {}).get("suspendedReplicas"),
        "at zero": lambda raw: api.get("Deployment", NORTH)["spec"]["replicas"] == 0,
    }[moment]
    api.wait_for("ApplicationInstance", NORTH, lambda raw: bool(reached(raw)), what=moment)
    manager.kill9()
    manager.start()
    wait_replicas(api, NORTH, 0)
    wait_suspended(api, NORTH, "True")
    wait_settled(api)

    end(api, "night")
    if moment == "wanted":
        api.wait_for("ApplicationInstance", NORTH, lambda raw: not raw["spec"]["suspended"], what="it resumes")
    manager.kill9()
    manager.start()
    wait_replicas(api, NORTH, 4)
    wait_suspended(api, NORTH, "False")
    wait_settled(api)


def test_an_autoscaled_workload_is_paused_and_resumes_with_its_replicas(api: Api, manager: Process) -> None:
    autoscaler = {
        "apiVersion": "autoscaling/v2",
        "kind": "HorizontalPodAutoscaler",
        "metadata": {"name": "${instance.name}"},
        "spec": {
            "scaleTargetRef": {"apiVersion": "apps/v1", "kind": "Deployment", "name": "${instance.name}"},
            "minReplicas": 3,
            "maxReplicas": 5,
            "metrics": [
                {
                    "type": "Resource",
                    "resource": {"name": "cpu", "target": {"type": "Utilization", "averageUtilization": 50}},
                }
            ],
        },
    }
    api.create(template(manifests=[deployment(), autoscaler]))  # the manifest has 1: the autoscaler's value applies
    api.create(task("north"))
    wait_replicas(api, NORTH, 3)
    wait_settled(api)
    api.create(acting("Suspend", "night"))
    wait_replicas(api, NORTH, 0)
    rests = "HorizontalPodAutoscaler", NORTH
    api.wait_for(
        *rests,
        lambda raw: condition(raw, "ScalingActive").get("reason") == "ScalingDisabled",
        what="the autoscaler has seen that its target is at zero and is inactive",
    )
    wait_replicas(api, NORTH, 0)
    instance = wait_suspended(api, NORTH, "True")
    assert f"HorizontalPodAutoscaler {NORTH} is inactive" in condition(instance, "Suspended")["message"]
    wait_settled(api)
    end(api, "night")
    wait_replicas(api, NORTH, 3)
    wait_settled(api)


def test_a_baseline_runs_without_tasks_and_is_recreated(api: Api, manager: Process) -> None:
    always = template(parameters={"rate": PARAMETERS["rate"]}, manifests=[config({"rate": "${parameters.rate} Hz"})])
    del always["spec"]["key"]
    always["spec"]["baseline"] = {"parameters": {"rate": 1}}
    api.create(always)
    wait_rate(api, "app", 1)
    faster = task("faster")
    faster["spec"]["parameters"] = {"rate": 7}
    api.create(faster)
    wait_rate(api, "app", 7)
    end(api, "faster")
    wait_rate(api, "app", 1)
    before = api.get("ApplicationInstance", "app")["metadata"]["uid"]
    api.delete("ApplicationInstance", "app")
    api.wait_for("ApplicationInstance", "app", lambda raw: raw["metadata"]["uid"] != before, what="it is recreated")
    wait_rate(api, "app", 1)
    wait_settled(api)
    api.patch("ApplicationTemplate", "app", {"spec": {"baseline": None}})
    api.wait_gone("ApplicationInstance", "app")
