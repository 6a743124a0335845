"""An application that is not ready in time, on a real control plane: reported, and replaced by the fallback."""

from __future__ import annotations

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import condition, end, start_manager, task, template, wait_settled
from tests.cluster.pods import mark_pods_ready
from tests.cluster.processes import Processes

FULL, LITE = instance_name("app", "north"), instance_name("lite", "north")
IN_TIME = {"linger": "1s", "readyTimeout": "2s"}


def wait_accepted(api: Api, name: str, reason: str) -> Object:
    return api.wait_for(
        "ApplicationTask",
        name,
        lambda raw: condition(raw, "Accepted").get("reason") == reason,
        what=f"Accepted of {name} has the reason {reason}",
    )


def wait_condition(api: Api, instance: str, type_: str, status: str, shows: str = "") -> Object:
    """Wait until the instance's condition has this status and its message contains `shows`; return it."""

    def holds(raw: Object) -> bool:
        found = condition(raw, type_)
        return found.get("status") == status and shows in found["message"]

    found = api.wait_for("ApplicationInstance", instance, holds, what=f"{type_} of {instance} is {status}, {shows}")
    return condition(found, type_)


def become_ready(api: Api, instance: str) -> None:
    api.wait_list("Pod", bool, labels=f"app={instance}", what=f"{instance} has a pod")
    mark_pods_ready(api, f"app={instance}")


def test_an_instance_that_is_not_ready_in_time_reports_it(api: Api, processes: Processes, namespace: str) -> None:
    start_manager(processes, namespace)
    api.create(template(lifecycle=IN_TIME))
    api.create(task("north"))
    reported = api.wait_for(
        "ApplicationTask",
        "north",
        lambda raw: condition(raw, "Ready").get("reason") == "ReadyTimeout",
        what="the task reports that its application was not ready in time",
    )
    assert f"instance {FULL} was not ready for 2s" in reported["status"]["message"]
    api.wait_for(
        "ApplicationInstance",
        FULL,
        lambda raw: (
            "not ready for 2s: Deployment" in condition(raw, "Ready").get("message", "")
            and "not ready for 2s" in raw["status"].get("message", "")
        ),
        what="the instance reports it too",
    )
    become_ready(api, FULL)
    api.wait_for(
        "ApplicationTask", "north", lambda raw: raw["status"]["phase"] == "Ready", what="it is served eventually"
    )
    assert wait_condition(api, FULL, "TimedOut", "False")["reason"] == "InTime"


def test_the_fallback_serves_until_the_primary_is_ready_across_restarts(
    api: Api, processes: Processes, namespace: str
) -> None:
    manager = start_manager(processes, namespace)
    api.create(template("lite", lifecycle={"linger": "0s"}))
    api.create(template(lifecycle={**IN_TIME, "fallback": {"templateName": "lite"}}))
    api.create(task("north"))
    fallen = wait_accepted(api, "north", "FallenBack")
    assert fallen["status"]["instanceName"] == LITE
    assert f"instance {FULL} is not ready; until it is, instance {LITE} of template lite" in fallen["status"]["message"]
    become_ready(api, LITE)
    api.wait_for("ApplicationTask", "north", lambda raw: raw["status"]["phase"] == "Ready", what="the fallback serves")
    wait_condition(api, FULL, "TimedOut", "True", LITE)
    wait_condition(api, LITE, "StandsIn", "True", FULL)
    wait_settled(api)

    uid = api.get("ApplicationInstance", LITE)["metadata"]["uid"]
    manager.kill9()
    manager.start()
    manager.wait_for_output("watching")
    api.create(task("second", region="north"))
    wait_accepted(api, "second", "FallenBack")
    wait_settled(api)
    assert api.get("ApplicationInstance", LITE)["metadata"]["uid"] == uid  # although it has no linger

    become_ready(api, FULL)
    manager.kill9()
    manager.start()
    assert wait_accepted(api, "north", "Accepted")["status"]["instanceName"] == FULL
    wait_accepted(api, "second", "Accepted")
    api.wait_gone("ApplicationInstance", LITE)
    wait_settled(api)
    end(api, "north")
    end(api, "second")
    api.wait_gone("ApplicationInstance", FULL)


def test_an_unusable_fallback_is_reported_and_used_once_it_is_valid(
    api: Api, processes: Processes, namespace: str
) -> None:
    start_manager(processes, namespace)
    api.create(template(lifecycle={**IN_TIME, "fallback": {"templateName": "lite"}}))
    api.create(task("north"))
    failed = wait_accepted(api, "north", "FallbackFailed")
    assert "there is no ApplicationTemplate 'lite': create it" in failed["status"]["message"]
    assert failed["status"]["instanceName"] == FULL
    api.create(template("lite"))
    assert wait_accepted(api, "north", "FallenBack")["status"]["instanceName"] == LITE
    wait_settled(api)
