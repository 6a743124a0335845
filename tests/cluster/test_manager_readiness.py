"""Ready means that the workload serves; the task reports why its pods do not run.

There is no kubelet here: the test writes the statuses of pods as a kubelet would.
"""

from __future__ import annotations

from typing import Any

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import condition, deployment, task, template, wait_settled
from tests.cluster.pods import running
from tests.cluster.processes import Process
from tests.cluster.waiting import wait_until

NORTH = instance_name("app", "north")
PODS = f"wayside.dev/instance={NORTH}"


def its_pod(api: Api) -> str:
    (found,) = api.wait_list("Pod", lambda found: len(found) == 1, labels=PODS, what="the pod has the instance's label")
    return str(found["metadata"]["name"])


def set_pod_status(api: Api, pod: str, **status: Any) -> None:
    api.patch("Pod", pod, {"status": status}, subresource="status")


def container(state: Object, **more: Any) -> list[Object]:
    whole = {"name": "main", "image": "app:1", "imageID": "", "ready": False, "restartCount": 0, "state": state}
    return [whole | more]


def waiting(reason: str, message: str) -> list[Object]:
    return container({"waiting": {"reason": reason, "message": message}})


def wait_for_ready(api: Api, kind: str, name: str, *, status: str = "False", reason: str, text: str) -> None:
    def holds(raw: Object) -> bool:
        found = condition(raw, "Ready")
        return (found.get("status"), found.get("reason")) == (status, reason) and text in found["message"]

    api.wait_for(kind, name, holds, what=f"Ready={status} of {kind} {name}, reason {reason}, contains {text!r}")


def test_task_and_instance_report_why_pods_do_not_run_until_they_do(api: Api, manager: Process) -> None:
    api.create(template(image="registry.example/app:9"))
    api.create(task("north"))
    pod = its_pod(api)

    def logged(reason: str, text: str) -> None:
        wait_for_ready(api, "ApplicationTask", "north", reason=reason, text=text)
        wait_for_ready(api, "ApplicationInstance", NORTH, reason=reason, text=text)

    unscheduled = {
        "type": "PodScheduled",
        "status": "False",
        "reason": "Unschedulable",
        "message": "0/3 nodes are free",
    }
    set_pod_status(api, pod, conditions=[unscheduled])
    logged("Unschedulable", "no node fits the pod: 0/3 nodes are free")
    set_pod_status(
        api, pod, conditions=[unscheduled | {"status": "True"}], containerStatuses=waiting("ErrImagePull", "not found")
    )
    logged("ImagePullFailed", "cannot pull image registry.example/app:9: not found")
    ended = {"exitCode": 137, "reason": "OOMKilled"}
    crashed = container({"waiting": {"reason": "CrashLoopBackOff"}}, lastState={"terminated": ended}, restartCount=2)
    set_pod_status(api, pod, containerStatuses=crashed)
    logged("CrashLoop", "container main crashes: it ended with exit code 137, killed for exceeding its memory limit")

    api.patch("Pod", pod, {"status": running(api.get("Pod", pod))}, subresource="status")
    wait_for_ready(api, "ApplicationTask", "north", status="True", reason="Ready", text="is ready")
    wait_for_ready(api, "ApplicationInstance", NORTH, status="True", reason="Ready", text="ready")
    ready = [
        each | {"status": "False"}
        for each in api.get("Pod", pod)["status"]["conditions"]
        if each["type"] != "PodScheduled"
    ]
    set_pod_status(api, pod, containerStatuses=crashed, conditions=ready)
    wait_for_ready(api, "ApplicationTask", "north", reason="CrashLoop", text="container main crashes")
    wait_for_ready(api, "ApplicationInstance", NORTH, reason="CrashLoop", text="has 0 of 1 pods available")
    wait_until(
        lambda: {each["reason"] for each in api.list("Event.events.k8s.io") if each["type"] == "Warning"},
        lambda warned: warned - {"FailedScheduling"} == {"CrashLoop", "ImagePullFailed", "Unschedulable"},
        what="the Events, which are posted in the background, warn of each",
    )
    wait_settled(api)


def test_a_new_version_that_does_not_run_is_not_ready_though_the_old_one_still_does(
    api: Api, manager: Process, kubelet: None
) -> None:
    api.create(template())
    api.create(task("north"))
    wait_for_ready(api, "ApplicationInstance", NORTH, status="True", reason="Ready", text="ready")
    changed = deployment(image="app:2")
    # Its pod becomes ready here, but not available.
    changed["spec"]["minReadySeconds"] = 500
    api.patch("ApplicationTemplate", "app", {"spec": {"manifests": [changed]}})
    wait_for_ready(api, "ApplicationInstance", NORTH, reason="NotReady", text=f"Deployment {NORTH} ")


def test_other_kinds_are_judged_by_their_conditions(api: Api, manager: Process) -> None:
    claim = {
        "apiVersion": "v1",
        "kind": "PersistentVolumeClaim",
        "metadata": {"name": "${instance.name}-data"},
        "spec": {"accessModes": ["ReadWriteOnce"], "resources": {"requests": {"storage": "1Gi"}}},
    }
    outside = {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {"name": "${instance.name}-out"},
        "spec": {"type": "LoadBalancer", "ports": [{"port": 80}]},
    }
    containers = [{"name": "main", "image": "app:1"}]
    job = {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {"name": "${instance.name}"},
        "spec": {"backoffLimit": 0, "template": {"spec": {"restartPolicy": "Never", "containers": containers}}},
    }
    api.create(template(manifests=[claim, outside, job]))
    api.create(task("north"))

    def wait_instance(*texts: str, status: str = "False") -> None:
        api.wait_for(
            "ApplicationInstance",
            NORTH,
            lambda raw: (
                condition(raw, "Ready").get("status") == status
                and all(each in condition(raw, "Ready")["message"] for each in texts)
            ),
            what=f"Ready={status} contains {texts}",
        )

    lacks_address = f"Service {NORTH}-out has no load balancer address"
    wait_instance("has no running pod", f"PersistentVolumeClaim {NORTH}-data is not bound", lacks_address)
    pod = its_pod(api)
    api.patch("Pod", pod, {"status": running(api.get("Pod", pod))}, subresource="status")
    api.patch("PersistentVolumeClaim", f"{NORTH}-data", {"status": {"phase": "Bound"}}, subresource="status")
    wait_instance(lacks_address)
    balancer = {"loadBalancer": {"ingress": [{"ip": "192.0.2.1"}]}}
    api.patch("Service", f"{NORTH}-out", {"status": balancer}, subresource="status")
    wait_instance(status="True")
    failed = container({"terminated": {"exitCode": 2, "reason": "Error"}}, ready=False)
    set_pod_status(api, pod, phase="Failed", containerStatuses=failed)
    wait_instance(f"Job {NORTH} has failed", "container main failed: it ended with exit code 2")
