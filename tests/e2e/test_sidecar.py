"""A detector as a sidecar on a real node: it sees its pod's data, acts, and does not affect the pod."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.core.objects.sidecars import CONTAINER
from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import condition
from tests.cluster.waiting import wait_until
from tests.e2e.released import MANAGER, RELEASE, available, image_values
from tests.e2e.wayside_in_cluster import RESTRICTED, ZENOH_PORT
from tests.e2e.workloads import deployment, wait_available
from tests.helm.wayside_chart import CHART, Helm
from tests.patience import NODE_PATIENCE
from wayside.process.startup import ENDED

DETECTOR = "on-board"
RETRIES = {"wayside.dev/detector": DETECTOR}
DRIVE = f"""
import json, signal, sys, time, zenoh
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
config = zenoh.Config.from_json5(json.dumps({{
    "mode": "client", "connect": {{"endpoints": ["tcp/127.0.0.1:{ZENOH_PORT}"], "timeout_ms": -1}},
}}))
with zenoh.open(config) as session:
    while True:
        session.put("vehicles/car1/speed", json.dumps({{"value": 50}}))
        time.sleep(0.1)
"""
"""The pod's own program: it publishes the car's speed over localhost."""
WAIT = "import time; time.sleep(10**6)"


def resources(image: str) -> list[Object]:
    stream = {"name": "speed", "key": "vehicles/${client:*}/speed", "encoding": "json"}
    zenoh = {"mode": "peer", "listen": [f"tcp/127.0.0.1:{ZENOH_PORT}"], "scouting": False}
    application = deployment("${instance.name}", image, ["python3", "-c", WAIT])
    return [
        wayside_object(
            "Detector",
            DETECTOR,
            mode="Sidecar",
            serviceAccountNames=["vehicle"],
            zenoh=zenoh,
            streams=[stream],
            clientTimeout="60s",
        ),
        wayside_object(
            "EventRule",
            "fast",
            signals=[{"name": "speed", "stream": "speed", "value": "msg.value"}],
            evaluation={"every": "100ms"},
            when="speed > 30",
            actions=[{"name": "deploy", "deploy": {"templateName": "app"}}],
        ),
        wayside_object(
            "ApplicationTemplate",
            "app",
            lifecycle={"linger": "1s", "onDetectorLoss": {"policy": "Release", "after": "1s"}},
            manifests=[application],
        ),
        {"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": "vehicle"}},
    ]


def wayside_object(kind: str, name: str, **spec: Any) -> Object:
    return {"apiVersion": "wayside.dev/v1alpha1", "kind": kind, "metadata": {"name": name}, "spec": spec}


def pod_spec(image: str, program: str) -> Object:
    """A pod spec that meets the restricted standard, with the account `vehicle` and no mounted token."""
    main = {"name": "main", "image": image, "imagePullPolicy": "Never", "command": ["python3", "-c", program]}
    return {
        "serviceAccountName": "vehicle",
        "automountServiceAccountToken": False,
        "containers": [main | {"securityContext": RESTRICTED | {"runAsUser": 1000}}],
    }


def sidecar_of(pod: Object) -> Object:
    """The status of the sidecar."""
    (found,) = (each for each in pod["status"]["initContainerStatuses"] if each["name"] == CONTAINER)
    return dict(found)


@pytest.fixture
def asking(api: Api, image: str, helm: Helm) -> None:
    """The chart is installed with its default values (webhooks and policy); all objects but the pods exist."""
    given = {"image": image_values(image), "crds": {"install": False}, "manager": {"namespaces": [api.namespace]}}
    helm("install", RELEASE, str(CHART), "--namespace", api.namespace, values=given)
    api.wait_for("Deployment", MANAGER, available, timeout=NODE_PATIENCE, what="the manager is available")
    for each in resources(image):
        api.apply(each)
    restricted = {"pod-security.kubernetes.io/enforce": "restricted"}
    api.patch("Namespace", api.namespace, {"metadata": {"labels": restricted}})
    api.wait_for(
        "Detector",
        DETECTOR,
        lambda raw: condition(raw, "Running").get("reason") == "InPods",
        timeout=NODE_PATIENCE,
        what="the accounts have their rights",
    )
    probe = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "probe", "labels": RETRIES}}
    wait_until(
        lambda: api.apply(probe | {"spec": pod_spec(image, WAIT)}, dry_run=True)["spec"].get("initContainers"),
        bool,
        timeout=NODE_PATIENCE,
        what="the API server calls the webhook for pods and reaches it",
    )


def test_a_pods_detector_sees_its_data_and_its_application_is_removed_with_the_pod(
    api: Api, image: str, asking: None
) -> None:
    pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "car", "labels": RETRIES}}
    api.create(pod | {"spec": pod_spec(image, DRIVE)})
    api.patch("Namespace", api.namespace, {"metadata": {"labels": {"pod-security.kubernetes.io/enforce": None}}})
    (task,) = api.wait_list(
        "ApplicationTask",
        lambda found: len(found) == 1 and found[0].get("status", {}).get("phase") == "Ready",
        timeout=NODE_PATIENCE,
        what="its task is Ready",
    )
    holder = f"{DETECTOR}.car"
    assert task["spec"]["requester"]["holder"] == holder
    application = task["status"]["instanceName"]
    wait_available(api, application)
    running = api.get("Pod", "car")
    assert sidecar_of(running)["restartCount"] == 0
    logged = "it runs in 1 of 1 pods with its label"
    api.wait_for("Detector", DETECTOR, lambda raw: condition(raw, "Running")["message"] == logged, what=logged)

    api.delete("Pod", "car")
    api.wait_gone("Pod", "car", timeout=NODE_PATIENCE)
    api.wait_gone("Lease", f"wayside-{holder}", timeout=NODE_PATIENCE)
    api.wait_gone("Deployment", application, timeout=NODE_PATIENCE)
    api.wait_list(
        "Pod", lambda found: not found, labels=f"app={application}", timeout=NODE_PATIENCE, what="its pods are removed"
    )


def test_a_job_with_a_detector_completes(api: Api, image: str, asking: None) -> None:
    template = {"metadata": {"labels": RETRIES}, "spec": pod_spec(image, "print('done')")}
    template["spec"]["restartPolicy"] = "Never"
    job = {"apiVersion": "batch/v1", "kind": "Job", "metadata": {"name": "nightly"}}
    api.create(job | {"spec": {"template": template}})
    api.wait_for(
        "Job",
        "nightly",
        lambda raw: condition(raw, "Complete").get("status") == "True",
        timeout=NODE_PATIENCE,
        what="it is",
    )
    (pod,) = api.list("Pod", labels="job-name=nightly")
    assert pod["status"]["phase"] == "Succeeded"
    # It ends on SIGTERM, also during its start; SIGKILL would come only after the whole grace period.
    assert sidecar_of(pod)["state"]["terminated"]["exitCode"] in (0, ENDED)
