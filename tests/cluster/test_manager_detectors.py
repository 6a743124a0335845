"""The manager runs Detectors of mode Standalone: their objects are created, changed and deleted, and the status reports
it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from application_manager.core.objects.detectors import detector_objects, detector_roles, object_name
from application_manager.core.objects.poddefaults import PodDefaults
from application_manager.core.objects.rights import detector_rights
from tests.cluster.api import Api, Object
from tests.cluster.chain import CARS, FAR, HOLDER, NEAR, Vehicles
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import condition, start_manager
from tests.cluster.faulty_proxy import faulty_proxy
from tests.cluster.processes import Process, Processes
from tests.cluster.test_manager_rbac import (
    ALLOWED,
    each_verb_is_missed,
    granted,
    may,
    printed,
    put,
    used,
    wait_in_force,
)
from tests.cluster.waiting import wait_until
from tests.ports import free_endpoint
from wayside.api import Detector

NAME = object_name("town")
KINDS = ("ServiceAccount", "Role", "RoleBinding", "Deployment")
RUNS = ("--detector-image", "wayside:1")


def detector(**spec: Any) -> Object:
    stream = {"name": "pose", "key": "vehicles/${client:*}/pose", "encoding": "json"}
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "Detector",
        "metadata": {"name": HOLDER},
        "spec": {"streams": [stream], "clientTimeout": "60s", **spec},
    }


def close_vehicles() -> Object:
    deploy = {"templateName": "recorder", "parameters": {"vehicles": "${[a.client, b.client]}"}}
    return {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "EventRule",
        "metadata": {"name": "close"},
        "spec": {
            "scope": {"pairs": {"position": {"stream": "pose", "x": "msg.x", "y": "msg.y"}, "within": 1000}},
            "evaluation": {"every": "100ms"},
            "when": "distance < 150",
            "until": "distance > 200",
            "actions": [{"name": "record", "deploy": deploy}],
        },
    }


def shows(api: Api, status: str, reason: str) -> Object:
    def holds(raw: Object) -> bool:
        logged = condition(raw, "Running")
        return (logged.get("status"), logged.get("reason")) == (status, reason)

    found = api.wait_for("Detector", HOLDER, holds, what=f"Running is {status}, {reason}")
    return condition(found, "Running")


def same(wanted: Any, live: Any) -> bool:
    """Whether the live object has everything in the manifest; it may have more."""
    if isinstance(wanted, dict):
        return isinstance(live, dict) and all(same(value, live.get(key)) for key, value in wanted.items())
    if isinstance(wanted, list):
        return len(wanted) == len(live) and all(map(same, wanted, live))
    return bool(wanted == live)


def is_made(api: Api) -> None:
    """Wait until all objects equal those of the pure function for the current Detector."""

    def unlike() -> list[str]:
        wanted = detector_objects(Detector.model_validate(api.get("Detector", HOLDER)), PodDefaults("wayside:1"))
        return [each["kind"] for each in wanted if not same(each, api.find(each["kind"], NAME))]

    wait_until(unlike, lambda found: not found, what="its objects match the Detector")


def copied(labels: dict[str, str], name: str, kind: str = "Deployment") -> Object:
    """An object of another owner that has all labels of a detector's object, and whose pods crash."""
    pod = {
        "metadata": {"labels": labels},
        "spec": {"containers": [{"name": "main", "image": "other:1"}]},
    }
    spec = {"replicas": 1, "selector": {"matchLabels": labels}, "template": pod}
    return {"apiVersion": "apps/v1", "kind": kind, "metadata": {"name": name, "labels": labels}, "spec": spec}


def test_a_foreign_object_with_copied_labels_is_ignored_and_left_alone(
    api: Api, processes: Processes, namespace: str
) -> None:
    manager = start_manager(processes, namespace, *RUNS)
    api.create(detector(mode="Standalone"))
    is_made(api)
    labels = api.get("Deployment", NAME)["metadata"]["labels"]
    # Their names sort before and after the detector's own.
    others = [api.create(copied(labels, each))["metadata"]["name"] for each in (f"{NAME[:-1]}a", f"{NAME}-other")]
    own = api.wait_list(
        "Pod",
        lambda found: {each["metadata"]["generateName"].rsplit("-", 2)[0] for each in found} >= {NAME, *others},
        labels=f"wayside.dev/runs={HOLDER}",
        what="all of them have pods",
    )
    for each in own:
        if not each["metadata"]["generateName"].startswith(f"{NAME}-other"):
            continue
        state = {"waiting": {"reason": "ErrImagePull", "message": "not the detector's"}}
        status = {"name": "main", "image": "other:1", "imageID": "", "ready": False, "restartCount": 0, "state": state}
        api.patch("Pod", each["metadata"]["name"], {"status": {"containerStatuses": [status]}}, subresource="status")

    manager.restart()  # it has only the listed objects
    manager.wait_for_output("watching")
    for seconds in ("30s", "20s"):
        api.patch("Detector", HOLDER, {"spec": {"clientTimeout": seconds}})
        is_made(api)
    reported = shows(api, "False", "NotReady")
    assert "not the detector's" not in reported["message"]
    api.patch("Detector", HOLDER, {"spec": {"mode": None}})
    for kind in KINDS:
        api.wait_gone(kind, NAME)
    for each in others:
        found = api.get("Deployment", each)
        assert found["metadata"]["generation"] == 1
        assert "deletionTimestamp" not in found["metadata"]


def test_a_detectors_objects_are_created_changed_and_deleted_with_it(
    api: Api, processes: Processes, namespace: str, kubelet: None
) -> None:
    start_manager(processes, namespace, *RUNS)
    api.create(detector(mode="Standalone"))
    is_made(api)
    shows(api, "True", "Running")
    first = api.get("Deployment", NAME)

    api.patch("Detector", HOLDER, {"spec": {"clientTimeout": "30s", "state": {"path": "/state"}}})
    is_made(api)
    generation = api.get("Deployment", NAME)["metadata"]["generation"]
    assert generation > first["metadata"]["generation"]
    shows(api, "True", "Running")
    changed = api.patch("Detector", HOLDER, {"spec": {"clientTimeout": "20s"}})
    api.wait_for(
        "Detector",
        HOLDER,
        lambda raw: raw["status"]["observedGeneration"] == changed["metadata"]["generation"],
        what="the change was looked at",
    )
    assert api.get("Deployment", NAME)["metadata"]["generation"] == generation

    api.delete("Role", NAME)
    api.patch("Deployment", NAME, {"spec": {"replicas": 0}})
    is_made(api)
    assert api.get("Deployment", NAME)["metadata"]["uid"] == first["metadata"]["uid"]

    api.patch("Detector", HOLDER, {"spec": {"mode": None}})
    for kind in KINDS:
        api.wait_gone(kind, NAME)
    api.wait_for("Detector", HOLDER, lambda raw: not condition(raw, "Running"), what="no condition Running")
    api.patch("Detector", HOLDER, {"spec": {"mode": "Standalone"}})
    is_made(api)
    api.delete("Detector", HOLDER)
    for kind in KINDS:
        api.wait_gone(kind, NAME)


def test_the_status_reports_why_the_detector_does_not_run(api: Api, processes: Processes, namespace: str) -> None:
    other = {"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": NAME}}
    foreign = api.create(other)
    manager = start_manager(processes, namespace)
    api.create(detector(mode="Standalone"))
    assert "--detector-image" in shows(api, "False", "NotRun")["message"]
    assert api.find("Deployment", NAME) is None
    manager.terminate()

    start_manager(processes, namespace, *RUNS)
    assert f"ServiceAccount {NAME} already exists" in shows(api, "False", "ObjectExists")["message"]
    assert api.get("ServiceAccount", NAME)["metadata"]["uid"] == foreign["metadata"]["uid"]
    assert api.find("Deployment", NAME) is None
    api.delete("ServiceAccount", NAME)
    is_made(api)
    shows(api, "False", "NotReady")
    (pod,) = api.wait_list("Pod", lambda found: len(found) == 1, what="its pod is created")
    waiting = {"waiting": {"reason": "ErrImagePull", "message": "not found"}}
    state = {"name": "detector", "image": "wayside:1", "imageID": "", "ready": False, "restartCount": 0}
    status = {"phase": "Pending", "containerStatuses": [{**state, "state": waiting}]}
    api.patch("Pod", pod["metadata"]["name"], {"status": status}, subresource="status")
    assert "cannot pull image wayside:1: not found" in shows(api, "False", "ImagePullFailed")["message"]


def test_the_pod_passes_the_restricted_standard(
    api: Api, control_plane: ControlPlane, processes: Processes, namespace: str
) -> None:
    labels = {
        "pod-security.kubernetes.io/enforce": "restricted",
        "pod-security.kubernetes.io/enforce-version": "latest",
    }
    control_plane.api().patch("Namespace", namespace, {"metadata": {"labels": labels}})
    start_manager(processes, namespace, *RUNS)
    paths = {"state": {"path": "/state"}, "recordings": {"path": "/data/recordings"}}
    volumes = [{"name": "data", "persistentVolumeClaim": {"claimName": "town"}}]
    mounts = [{"name": "data", "mountPath": "/data"}]
    pod = {"volumes": volumes, "volumeMounts": mounts, "secretNames": ["pager"]}
    api.create(detector(mode="Standalone", pod=pod, **paths))
    api.wait_list("Pod", lambda found: len(found) == 1, what="its pod is created")


def test_the_printed_rights_suffice_to_run_a_detector(
    api: Api, processes: Processes, namespace: str, control_plane: ControlPlane, kubelet: None
) -> None:
    api.create({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": "manager"}})
    account = control_plane.kubeconfig_of_service_account(namespace, "manager")
    manifests = printed("--namespace", namespace, "--account", f"{namespace}/manager", "--detectors", *ALLOWED)
    put(api, manifests)
    wait_in_force(account, namespace, manifests)
    manager = start_manager(processes, namespace, *RUNS, *ALLOWED, kubeconfig=account)
    api.create(detector(mode="Standalone"))
    is_made(api)
    shows(api, "True", "Running")
    api.patch("Detector", HOLDER, {"spec": {"mode": None}})
    for kind in KINDS:
        api.wait_gone(kind, NAME)
    assert manager.terminate() == 0
    assert "orbidden" not in manager.output()
    assert "service account cannot" not in manager.output()


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def run_detector(processes: Processes, namespace: str, kubeconfig: Path) -> Process:
    environment = {"KUBECONFIG": str(kubeconfig)}
    started = processes.start("detector", "run", "--name", HOLDER, "--namespace", namespace, environment=environment)
    started.wait_for_output(f"Detector {HOLDER} runs with 1 rules")
    return started


def live(found: list[Object]) -> list[Object]:
    return [each for each in found if "endTime" not in each["spec"]]


def test_a_detector_needs_exactly_the_rights_of_its_role(
    api: Api, processes: Processes, namespace: str, control_plane: ControlPlane, endpoint: str
) -> None:
    roles = detector_roles(namespace, HOLDER)
    put(api, roles)
    account = control_plane.kubeconfig_of_service_account(namespace, NAME)
    wait_in_force(account, namespace, roles)
    api.create(detector(zenoh={"mode": "peer", "listen": [endpoint]}))
    api.create(close_vehicles())
    with faulty_proxy(account) as (proxy, kubeconfig):
        running = run_detector(processes, namespace, kubeconfig)
        with Vehicles(endpoint) as vehicles:
            vehicles.place(CARS, NEAR)
            (task,) = api.wait_list("ApplicationTask", lambda found: len(live(found)) == 1, what="a task exists")
            api.delete("ApplicationTask", task["metadata"]["name"])
            api.wait_list("ApplicationTask", lambda found: len(live(found)) == 1, what="the task exists again")
            vehicles.place(CARS, FAR)
            api.wait_list("ApplicationTask", lambda found: bool(found) and not live(found), what="the task has ended")
        renewed = api.get("Lease", f"wayside-{HOLDER}")["spec"]["renewTime"]
        api.wait_for(
            "Lease", f"wayside-{HOLDER}", lambda raw: raw["spec"]["renewTime"] != renewed, what="its Lease is renewed"
        )
        assert running.terminate() == 0
        requested = set(used(proxy.seen, namespace))
    assert requested <= granted(roles)
    # the chart's policy checks `hold` at the API server; a task is read and deleted after a crash within a write.
    seldom = {("applicationtasks", "get"), ("applicationtasks", "delete"), ("detectors", "hold")}
    assert {(resource, verb) for _, resource, verb in granted(roles) - requested} <= seldom
    assert "orbidden" not in running.output()


def test_each_verb_of_the_detectors_role_is_granted_and_a_removed_one_is_denied(
    api: Api, namespace: str, control_plane: ControlPlane
) -> None:
    roles = detector_roles(namespace, HOLDER)
    put(api, roles)
    account = Api(control_plane.kubeconfig_of_service_account(namespace, NAME), namespace)

    def lacks() -> list[tuple[str, str, str]]:
        return sorted(
            (right.group, right.resource, verb)
            for right in detector_rights(HOLDER)
            for verb in right.verbs
            if not may(account, namespace, right.group, right.resource, verb, right.name)
        )

    wait_until(lacks, lambda found: not found, what="nothing lacks")
    assert not may(account, namespace, "coordination.k8s.io", "leases", "update", "wayside-other")
    assert not may(account, namespace, "wayside.dev", "detectors", "hold", "other")
    each_verb_is_missed(api, roles, lacks)
