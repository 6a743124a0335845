"""Limits on a real control plane: what runs, what waits, what yields, and each task's status."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, Object, Objects
from tests.cluster.expected_objects import condition, end, start_manager, task, template, wait_settled
from tests.cluster.processes import Processes
from tests.cluster.repeating import repeated
from tests.cluster.waiting import wait_until

LOW, HIGH = (instance_name("app", each) for each in ("low", "high"))


def wanting(name: str, priority: int = 0, **more: Any) -> Object:
    made = task(name, **more)
    made["spec"]["priority"] = priority
    return made


def limited(count: int, **lifecycle: str) -> Object:
    return template(maxInstances=count, lifecycle={"linger": "1s", **lifecycle})


def wait_task(api: Api, name: str, phase: str, reason: str = "Accepted") -> Object:
    """Wait until the task has the phase, and Accepted the reason; return it."""
    return api.wait_for(
        "ApplicationTask",
        name,
        lambda raw: raw.get("status", {}).get("phase") == phase and condition(raw, "Accepted").get("reason") == reason,
        what=f"{name} is {phase}, {reason}",
    )


def wait_instance(api: Api, name: str, holds: Callable[[Object], bool], what: str) -> Object:
    """Wait until `holds` is true for the instance, whose status is written separately from its tasks'; return it."""
    return api.wait_for("ApplicationInstance", name, holds, what=f"instance {name} {what}")


def wait_event(api: Api, reason: str) -> None:
    """Wait for an Event with this reason: Events are posted in the background, and a killed manager posts none."""
    api.wait_list(
        "Event", lambda found: reason in {each["reason"] for each in found}, what=f"an Event {reason} is posted"
    )


@contextmanager
def never_more_than(api: Api, count: int) -> Iterator[None]:
    """Count the instances continuously; fail at the end of the block if there were ever more than `count`."""
    most = 0

    def look() -> None:
        nonlocal most
        most = max(most, len(api.list("ApplicationInstance")))

    with repeated("counting", look, 0.02):
        yield
    assert 0 < most <= count


def test_a_higher_priority_preempts_a_lower_one_until_it_ends(api: Api, processes: Processes, namespace: str) -> None:
    manager = start_manager(processes, namespace)
    api.create(limited(1))
    api.create(wanting("low"))
    wait_task(api, "low", "Active")
    api.create(wanting("other"))
    waiting = wait_task(api, "other", "Waiting", "LimitReached")
    assert "template app is at its limit of 1 instance (spec.maxInstances)" in waiting["status"]["message"]
    wait_event(api, "LimitReached")
    manager.kill9()
    api.create(wanting("high", 5))
    manager.start()
    with never_more_than(api, 1):
        gave = wait_task(api, "low", "Waiting", "Preempted")
        assert f"was preempted by instance {HIGH} (task high, priority 5)" in gave["status"]["message"]
        got = wait_task(api, "high", "Active")
        assert f"preempts instance {LOW} (task low, priority 0)" in condition(got, "Accepted")["message"]
        wait_settled(api)
        assert [each["metadata"]["name"] for each in api.list("ApplicationInstance")] == [HIGH]
        wait_event(api, "Preempted")
        manager.kill9()
        manager.start()
        end(api, "high")
        wait_task(api, "low", "Active")
        wait_settled(api)
    assert condition(api.get("ApplicationTask", "other"), "Accepted")["reason"] == "LimitReached"


def test_the_namespace_limit_covers_all_templates(api: Api, processes: Processes, namespace: str) -> None:
    start_manager(processes, namespace, "--max-instances", "2")
    api.create(template())
    api.create(template("map"))
    with never_more_than(api, 2):
        api.create(wanting("a"))
        api.create(wanting("b", of="map"))
        wait_task(api, "a", "Active")
        wait_task(api, "b", "Active")
        api.create(wanting("c", of="map"))
        waiting = wait_task(api, "c", "Waiting", "LimitReached")
        assert "the namespace is at its limit of 2 instances" in waiting["status"]["message"]
        end(api, "a")  # of another template; lingering instances yield
        wait_task(api, "c", "Active")
        wait_settled(api, limit=2)


def test_nothing_is_preempted_before_its_min_uptime(api: Api, processes: Processes, namespace: str) -> None:
    manager = start_manager(processes, namespace)
    api.create(limited(1, minUptime="6h"))
    api.create(wanting("low"))
    wait_task(api, "low", "Active")
    api.create(wanting("high", 5))
    wait_task(api, "high", "Waiting", "LimitReached")
    manager.kill9()
    manager.start()
    uid = api.get("ApplicationInstance", LOW)["metadata"]["uid"]
    end(api, "low")  # nor is it released
    released = api.wait_for(
        "ApplicationInstance", LOW, lambda raw: "releaseTime" in raw["status"], what="it has a release time"
    )
    assert released["metadata"]["uid"] == uid
    wait_settled(api)
    api.patch("ApplicationTemplate", "app", {"spec": {"lifecycle": {"minUptime": "0s"}}})
    wait_task(api, "high", "Active")
    wait_settled(api)


def quota(hard: dict[str, str]) -> Object:
    return {"apiVersion": "v1", "kind": "ResourceQuota", "metadata": {"name": "few"}, "spec": {"hard": hard}}


def wait_enforced(api: Api) -> None:
    api.wait_for("ResourceQuota", "few", lambda raw: bool(raw.get("status", {}).get("hard")), what="the quota holds")


def raise_quota(api: Api, hard: dict[str, str]) -> None:
    """Raise the quota and wait until it applies: admission reads the status, which a controller writes later."""
    api.patch("ResourceQuota", "few", {"spec": {"hard": hard}})
    api.wait_for("ResourceQuota", "few", lambda raw: raw["status"]["hard"] == hard, what="the raised quota holds")


def beyond_the_quota(api: Api, name: str) -> Object:
    """The task of this name, once it reports that it waits for the quota."""
    return api.wait_for(
        "ApplicationTask",
        name,
        lambda raw: "exceeded quota: few" in raw.get("status", {}).get("message", ""),
        what="the task reports that the quota is exceeded",
    )


def test_an_object_beyond_the_quota_is_reported_and_created_once_there_is_room(
    api: Api, processes: Processes, namespace: str
) -> None:
    api.create(quota({"count/deployments.apps": "1"}))
    wait_enforced(api)
    manager = start_manager(processes, namespace)
    api.create(template())
    api.create(task("low"))
    wait_task(api, "low", "Active")
    api.create(task("high"))
    reported = beyond_the_quota(api, "high")
    assert reported["status"]["phase"] == "Pending"
    assert f"Deployment {HIGH}" in reported["status"]["message"]
    assert "raise the ResourceQuota" in reported["status"]["message"]
    wait_instance(
        api,
        HIGH,
        lambda raw: (
            condition(raw, "Applied").get("reason") == "QuotaExceeded" and raw["status"].get("phase") == "Failed"
        ),
        "has failed for the quota",
    )
    raise_quota(api, {"count/deployments.apps": "2"})
    wait_task(api, "high", "Active")
    wait_settled(api)
    assert manager.alive


def test_an_instance_beyond_the_quota_is_reported_to_its_tasks(api: Api, processes: Processes, namespace: str) -> None:
    api.create(quota({"count/applicationinstances.wayside.dev": "1"}))
    wait_enforced(api)
    start_manager(processes, namespace)
    api.create(template())
    api.create(task("low"))
    wait_task(api, "low", "Active")
    api.create(task("high"))
    reported = beyond_the_quota(api, "high")
    assert f"cannot create instance {HIGH}" in reported["status"]["message"]
    assert reported["status"]["phase"] == "Pending"
    raise_quota(api, {"count/applicationinstances.wayside.dev": "2"})
    wait_task(api, "high", "Active")
    wait_settled(api)


def test_pods_beyond_the_quota_are_reported_to_the_tasks(api: Api, processes: Processes, namespace: str) -> None:
    api.create(quota({"pods": "0"}))
    wait_enforced(api)
    start_manager(processes, namespace)
    api.create(template())
    api.create(task("low"))
    reported = api.wait_for(
        "ApplicationTask",
        "low",
        lambda raw: condition(raw, "Ready").get("reason") == "QuotaExceeded",
        what="the task's Ready reports that pods are beyond the quota",
    )
    assert "pods are refused: forbidden: exceeded quota: few" in reported["status"]["message"]
    wait_instance(
        api,
        LOW,
        lambda raw: condition(raw, "Ready").get("reason") == "QuotaExceeded",
        "reports the same of its pods",
    )


def test_a_rejection_by_a_limit_range_is_reported_too(api: Api, processes: Processes, namespace: str) -> None:
    most = {"type": "PersistentVolumeClaim", "max": {"storage": "1Gi"}}
    spec = {"limits": [most]}
    api.create({"apiVersion": "v1", "kind": "LimitRange", "metadata": {"name": "small"}, "spec": spec})
    start_manager(processes, namespace)
    claim = {
        "apiVersion": "v1",
        "kind": "PersistentVolumeClaim",
        "metadata": {"name": "${instance.name}"},
        "spec": {"accessModes": ["ReadWriteOnce"], "resources": {"requests": {"storage": "2Gi"}}},
    }
    api.create(template(manifests=[claim]))
    api.create(task("low"))
    reported = api.wait_for(
        "ApplicationInstance",
        LOW,
        lambda raw: condition(raw, "Applied").get("reason") == "AdmissionRefused",
        what="the instance reports that the claim is not admitted",
    )
    assert "maximum storage usage per PersistentVolumeClaim is 1Gi" in reported["status"]["message"]
    api.patch("LimitRange", "small", {"spec": {"limits": [{**most, "max": {"storage": "2Gi"}}]}})
    api.wait_for("PersistentVolumeClaim", LOW, lambda raw: True, what="the claim is created")


def test_lowering_and_raising_a_limit_stops_and_starts_the_last_instance(
    api: Api, processes: Processes, namespace: str
) -> None:
    start_manager(processes, namespace)
    api.create(limited(3))
    for priority, name in enumerate(("low", "other", "high")):
        api.create(wanting(name, priority))
        wait_task(api, name, "Active")
    api.patch("ApplicationTemplate", "app", {"spec": {"maxInstances": 2}})
    wait_task(api, "low", "Waiting", "Preempted")
    api.wait_gone("ApplicationInstance", LOW)
    wait_settled(api)
    api.patch("ApplicationTemplate", "app", {"spec": {"maxInstances": None}})
    wait_task(api, "low", "Active")
    wait_settled(api)


@pytest.mark.parametrize("kind", ["StatefulSet", "Job"])
def test_pod_rejections_known_only_from_events_are_reported_and_resolved_once_there_is_room(
    kind: str, api: Api, processes: Processes, namespace: str
) -> None:
    api.create(quota({"pods": "0"}))
    wait_enforced(api)
    start_manager(processes, namespace)
    api.create(template(manifests=[workload(kind)]))
    api.create(task("low"))
    reported = beyond_the_quota(api, "low")
    assert reported["status"]["phase"] == "Active"
    logged = wait_instance(
        api,
        LOW,
        lambda raw: condition(raw, "Ready").get("reason") == "QuotaExceeded",
        "reports the same of its pods",
    )
    ready = condition(logged, "Ready")
    assert ready["status"] == "False"
    assert 'pods "' not in ready["message"]  # the name differs each time
    raise_quota(api, {"pods": "2"})
    changes = itertools.count()

    def pods() -> Objects:
        # A controller reconciles on changes, and the API server may see the new quota only after that.
        api.patch(kind, LOW, {"metadata": {"annotations": {"changed": str(next(changes))}}})
        return api.list("Pod")

    wait_until(pods, bool, what="a pod exists")
    api.wait_for(
        "ApplicationInstance",
        LOW,
        lambda raw: condition(raw, "Ready")["reason"] != "QuotaExceeded",
        what="it is no longer reported",
    )


def workload(kind: str) -> Object:
    """A workload of this kind, with one pod."""
    pod: Object = {"spec": {"containers": [{"name": "main", "image": "app:1"}]}}
    made: Object = {"kind": kind, "metadata": {"name": "${instance.name}"}}
    if kind == "Job":
        pod["spec"]["restartPolicy"] = "Never"
        return {"apiVersion": "batch/v1", **made, "spec": {"template": pod}}
    labels = {"app": "${instance.name}"}
    pod["metadata"] = {"labels": labels}
    spec = {"serviceName": "none", "selector": {"matchLabels": labels}, "template": pod}
    return {"apiVersion": "apps/v1", **made, "spec": spec}
