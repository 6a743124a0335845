"""After failures of the manager, the API server or the objects, the cluster again matches the demands."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import pytest

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, ApiError, Object
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import (
    condition,
    config,
    deployment,
    end,
    start_manager,
    task,
    template,
    wait_settled,
)
from tests.cluster.processes import Process, Processes
from tests.cluster.test_manager_metrics import scraped
from tests.cluster.waiting import wait_until
from tests.ports import free_port
from wayside.kubernetes.leases import HOLDER_LEASE_LABEL
from wayside.times import parse_seconds

NORTH = instance_name("app", "north")
SOUTH = instance_name("app", "south")
LONG = 600  # s: a Lease that outlasts the test
EVERY_KIND = ("ApplicationTemplate", "ApplicationTask", "ApplicationInstance", "Deployment", "ConfigMap")


def versions(api: Api) -> dict[tuple[str, str], str]:
    """The resourceVersion of every object, which any write changes."""
    return {
        (kind, raw["metadata"]["name"]): raw["metadata"]["resourceVersion"]
        for kind in EVERY_KIND
        for raw in api.list(kind)
    }


def quiet(api: Api) -> dict[tuple[str, str], str]:
    """Wait until all writes have stopped; return the versions."""
    api.wait_list("Deployment", lambda found: all(map(has_pods, found)), what="the controllers are done")
    last: dict[str, Any] = {"versions": {}, "since": time.monotonic()}

    def seconds() -> float:
        now = versions(api)
        if now != last["versions"]:
            last.update(versions=now, since=time.monotonic())
        return time.monotonic() - float(last["since"])

    wait_until(seconds, lambda quiet_for: quiet_for > 3.0, what="all writes are done")
    found: dict[tuple[str, str], str] = last["versions"]
    return found


def has_pods(raw: Object) -> bool:
    """Whether the controllers have observed the current Deployment and created its pods."""
    status = raw.get("status", {})
    seen = status.get("observedGeneration") == raw["metadata"]["generation"]
    return bool(seen and status.get("updatedReplicas") == raw["spec"]["replicas"])


def wait_deployment(api: Api, name: str) -> Object:
    return api.wait_for("Deployment", name, lambda _: True, what=f"Deployment {name} exists")


def test_a_manager_killed_while_serving_a_hundred_tasks_finishes_after_its_restart(api: Api, manager: Process) -> None:
    api.create(template())
    regions = [f"r{index}" for index in range(50)]
    tasks = [task(f"{region}-{twin}", region=region) for region in regions for twin in ("a", "b")]
    with ThreadPoolExecutor(4) as pool:
        creating = [pool.submit(api.create, each) for each in tasks[:60]]
        api.wait_list("Deployment", lambda found: len(found) >= 10, what="the manager has served some of the tasks")
        manager.kill9()
        for each in creating:
            each.result()
    assert len(api.list("Deployment")) < len(regions)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(api.create, tasks[60:]))
        list(pool.map(lambda region: end(api, f"{region}-a"), regions[::2]))
        list(pool.map(lambda region: end(api, f"{region}-b"), regions[:20:2]))
    manager.start()
    wait_settled(api)
    api.wait_list("Deployment", lambda found: len(found) == 40, what="exactly the 40 demanded instances exist")


@pytest.mark.own_control_plane
def test_an_outage_of_the_api_server_releases_nothing(api: Api, manager: Process, control_plane: ControlPlane) -> None:
    api.create(template())
    # The holder's Lease expires after 25 s; the outage takes 30 s, in which it cannot be renewed.
    api.create(template("held", lifecycle={"linger": "1s", "onDetectorLoss": {"policy": "Release", "after": "1s"}}))
    lease: Object = {
        "apiVersion": "coordination.k8s.io/v1",
        "kind": "Lease",
        "metadata": {"name": "wayside-det", "labels": {HOLDER_LEASE_LABEL: "true"}},
        "spec": {"holderIdentity": "det", "leaseDurationSeconds": LONG, "renewTime": "2026-01-01T00:00:00.000000Z"},
    }
    api.create(lease)
    api.create(task("north"))
    api.create(task("held", of="held", holder="det"))
    held = instance_name("held", "held")
    before = [wait_deployment(api, name)["metadata"]["uid"] for name in (NORTH, held)]
    control_plane.stop_controller_manager()  # otherwise it starts with the API server, and the holder waits for it
    short = {"leaseDurationSeconds": 24, "renewTime": "2026-01-01T00:00:10.000000Z"}
    api.patch("Lease", "wayside-det", {"spec": short})
    api.create(task("west"))
    wait_deployment(api, instance_name("app", "west"))  # by now the manager has seen that the Lease was renewed
    control_plane.stop_api_server()
    try:
        time.sleep(30)  # the outage is under test
    finally:
        control_plane.start_api_server()
    api.create(task("south"))
    wait_deployment(api, SOUTH)  # the manager works again, and has read the Lease before the holder renews it
    renewed = {"leaseDurationSeconds": LONG, "renewTime": "2026-01-01T00:00:40.000000Z"}
    api.patch("Lease", "wayside-det", {"spec": renewed})
    control_plane.start_controller_manager()
    wait_settled(api)
    assert [api.get("Deployment", name)["metadata"]["uid"] for name in (NORTH, held)] == before
    assert manager.alive


def test_a_manually_deleted_deployment_is_recreated_and_a_manually_changed_field_is_reset(
    api: Api, manager: Process
) -> None:
    api.create(template())
    api.create(task("north"))
    wait_deployment(api, NORTH)
    wait_settled(api)
    uid = api.get("Deployment", NORTH)["metadata"]["uid"]
    api.delete("Deployment", NORTH)
    api.wait_for("Deployment", NORTH, lambda raw: raw["metadata"]["uid"] != uid, what="it is back")
    wait_settled(api)
    api.patch("Deployment", NORTH, {"spec": {"replicas": 5}})
    api.wait_for("Deployment", NORTH, lambda raw: raw["spec"]["replicas"] == 1, what="the field is reset")


def test_a_foreign_object_is_left_alone(api: Api, manager: Process) -> None:
    api.create({**deployment("theirs:1", NORTH), "metadata": {"name": NORTH, "labels": {"theirs": "yes"}}})
    before = api.get("Deployment", NORTH)
    api.create(template())
    api.create(task("north"))
    api.create(task("south"))
    wait_deployment(api, SOUTH)
    reported = api.wait_for(
        "ApplicationInstance",
        NORTH,
        lambda raw: condition(raw, "Applied").get("reason") == "ObjectExists",
        what="the instance reports the problem",
    )
    message = condition(reported, "Applied")["message"]
    assert f"Deployment {NORTH} already exists" in message
    assert "delete or rename it" in message
    pending = api.wait_for(
        "ApplicationTask", "north", lambda raw: raw.get("status", {}).get("phase") == "Pending", what="the task waits"
    )
    assert "already exists" in condition(pending, "Applied")["message"]
    now = api.get("Deployment", NORTH)
    assert now["metadata"]["generation"] == before["metadata"]["generation"]
    assert "ownerReferences" not in now["metadata"]
    # The end of the demand does not change it either; once it is deleted, the manager creates its own.
    api.delete("Deployment", NORTH)
    api.wait_for(
        "Deployment",
        NORTH,
        lambda raw: "ownerReferences" in raw["metadata"],
        what="the manager has created its own",
    )
    wait_settled(api)


def test_a_template_change_is_applied_to_its_instances_only(api: Api, manager: Process) -> None:
    api.create(template())
    api.create(template("other"))
    api.create(task("north"))
    api.create(task("south"))
    api.create(task("bystander", of="other"))
    bystander = instance_name("other", "bystander")
    for name in (NORTH, SOUTH, bystander):
        wait_deployment(api, name)
    before = quiet(api)
    changed = template(manifests=[deployment("app:2"), config({"a": "b"})])
    api.patch("ApplicationTemplate", "app", {"spec": changed["spec"]})
    for name in (NORTH, SOUTH):
        api.wait_for(
            "Deployment",
            name,
            lambda raw: raw["spec"]["template"]["spec"]["containers"][0]["image"] == "app:2",
            what="the Deployment has the new image",
        )
    wait_settled(api)
    after = quiet(api)
    for key in (("Deployment", bystander), ("ApplicationInstance", bystander), ("ApplicationTask", "bystander")):
        assert after[key] == before[key]
    # Manifests removed from the template are pruned; the Deployments stay unchanged.
    generation = api.get("Deployment", NORTH)["metadata"]["generation"]
    api.patch("ApplicationTemplate", "app", {"spec": {"manifests": [deployment("app:2")]}})
    api.wait_gone("ConfigMap", f"{NORTH}-config")
    api.wait_gone("ConfigMap", f"{SOUTH}-config")
    wait_settled(api)
    assert api.get("Deployment", NORTH)["metadata"]["generation"] == generation


def test_a_template_that_becomes_invalid_leaves_running_objects_unchanged(api: Api, manager: Process) -> None:
    api.create(template(manifests=[deployment(), config({"a": "b"})]))
    api.create(task("north"))
    wait_deployment(api, NORTH)
    wait_settled(api)
    before = {key: value for key, value in quiet(api).items() if key[0] in ("Deployment", "ConfigMap")}
    api.patch("ApplicationTemplate", "app", {"spec": {"manifests": [deployment("app:${parameters.version}")]}})
    reported = api.wait_for(
        "ApplicationInstance",
        NORTH,
        lambda raw: condition(raw, "Applied").get("reason") == "RenderFailed",
        what="the instance reports the error",
    )
    assert "`parameters.version` does not exist" in condition(reported, "Applied")["message"]
    wait_settled(api)
    after = quiet(api)
    assert {key: after[key] for key in before} == before
    api.patch("ApplicationTemplate", "app", {"spec": {"manifests": [deployment("app:2")]}})
    api.wait_gone("ConfigMap", f"{NORTH}-config")
    wait_settled(api)


def test_an_instance_lingers_and_is_released_when_its_template_is_deleted(api: Api, manager: Process) -> None:
    api.create(template(linger="8s"))
    api.create(task("north"))
    wait_deployment(api, NORTH)
    wait_settled(api)
    api.delete("ApplicationTemplate", "app")
    api.wait_for("ApplicationInstance", NORTH, lambda raw: "releaseTime" in raw.get("status", {}), what="it lingers")
    refused = api.wait_for(
        "ApplicationTask",
        "north",
        lambda raw: raw.get("status", {}).get("phase") == "Refused",
        what="the task is refused",
    )
    assert condition(refused, "Accepted")["reason"] == "TemplateNotFound"
    api.wait_gone("ApplicationInstance", NORTH)
    api.wait_gone("Deployment", NORTH)
    wait_settled(api)
    api.create(template())
    wait_deployment(api, NORTH)
    wait_settled(api)


def test_a_linger_continues_through_a_restart(api: Api, manager: Process) -> None:
    api.create(template(linger="15s"))
    api.create(task("north"))
    wait_deployment(api, NORTH)
    end(api, "north")
    lingering = api.wait_for(
        "ApplicationInstance",
        NORTH,
        lambda raw: "releaseTime" in raw.get("status", {}),
        what="the deadline is set",
    )
    manager.kill9()
    manager.start()
    manager.wait_for_output("watching")
    deadline = lingering["status"]["releaseTime"]

    def gone() -> bool:
        found = api.find("ApplicationInstance", NORTH)
        assert found is None or found["status"]["releaseTime"] == deadline
        return found is None

    wait_until(gone, bool, what="it goes")
    assert time.time() >= parse_seconds(deadline), "not before the end of the linger"
    wait_settled(api)
    api.wait_gone("Deployment", NORTH)
    assert not api.list("ApplicationInstance")


def test_a_manually_deleted_instance_is_recreated_after_its_objects_are_gone(api: Api, manager: Process) -> None:
    api.create(template())
    api.create(task("north"))
    uid = wait_deployment(api, NORTH)["metadata"]["uid"]
    wait_settled(api)
    api.delete("ApplicationInstance", NORTH)
    api.wait_for("Deployment", NORTH, lambda raw: raw["metadata"]["uid"] != uid, what="another Deployment exists")
    wait_settled(api)


def test_a_restart_and_a_resync_write_nothing(api: Api, processes: Processes, namespace: str) -> None:
    port = free_port()
    manager = start_manager(processes, namespace, "--resync", "1s", "--metrics-port", str(port))
    api.create(template(manifests=[deployment(), config({"a": "b"})]))
    api.create(task("north"))
    api.create(task("twin", region="north"))
    api.create(task("wrong", of="nowhere"))
    wait_deployment(api, NORTH)
    wait_settled(api)
    counted = "its status counts the instance"  # after a check in a worker process, so it may be late
    api.wait_for("ApplicationTemplate", "app", lambda raw: raw.get("status", {}).get("instances") == 1, what=counted)
    before = quiet(api)
    manager.restart()
    manager.wait_for_output("watching")
    first = wait_until(lambda: resynced(port), bool, what="everything was listed after the start")
    wait_until(lambda: resynced(port), lambda at: at > first + 2, what="and twice again")
    assert versions(api) == before


def resynced(port: int) -> float:
    """The time of the last list of everything, in seconds since 1970; 0: none yet, or no answer."""
    with suppress(OSError):
        return scraped(port)["resync_time_seconds",]
    return 0.0


def test_a_namespace_being_deleted_is_left_without_errors(api: Api, manager: Process, namespace: str) -> None:
    api.create(template())
    for index in range(5):
        api.create(task(f"r{index}"))
    api.wait_list("Deployment", lambda found: len(found) == 5, what="all is there")
    api.delete("Namespace", namespace)
    api.wait_list("ApplicationTask", lambda found: not found, what="the tasks are deleted")
    api.wait_list("Deployment", lambda found: not found, what="the Deployments are deleted")
    assert manager.terminate() == 0
    assert "Traceback" not in manager.output()
    assert "WARNING" not in manager.output()


@pytest.mark.own_control_plane
def test_a_cluster_that_drops_selectable_fields_is_rejected_at_the_start(
    api: Api, processes: Processes, namespace: str
) -> None:
    """Kubernetes 1.30 drops them, so an instance would never be released."""
    kind, name = "CustomResourceDefinition", "applicationtasks.wayside.dev"
    versions_with = api.get(kind, name)["spec"]["versions"]
    versions_without = [
        {key: value for key, value in each.items() if key != "selectableFields"} for each in versions_with
    ]

    def selects() -> bool:
        try:
            api.list("ApplicationTask", fields="spec.templateName=none")
        except ApiError as error:
            return error.code != 400
        return True

    api.patch(kind, name, {"spec": {"versions": versions_without}})
    try:
        wait_until(selects, lambda can: not can, what="the field cannot be selected")
        manager = processes.start("application-manager", "run", "--namespace", namespace)
        assert manager.wait() == 2
        assert "cannot select ApplicationTasks by spec.templateName" in manager.output()
        assert "Kubernetes 1.31 or newer" in manager.output()
    finally:
        api.patch(kind, name, {"spec": {"versions": versions_with}})
        wait_until(selects, bool, what="the field can be selected again")
