"""The chart's router on a real node: vehicles outside the cluster publish over mutual TLS, and an application runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.certificates import Authority
from tests.cluster.api import Api
from tests.cluster.waiting import wait_until
from tests.e2e.node import Node
from tests.e2e.released import RELEASE, ROUTER, apply_certificates, router_endpoint, values, vehicle, wait_installed
from tests.e2e.workloads import deployment
from tests.helm.wayside_chart import CHART, Helm
from tests.patience import NODE_PATIENCE

RULE = {
    "signals": [{"name": "speed", "stream": "speed", "value": "msg.value"}],
    "when": "speed > 30",
    "actions": [{"name": "watch", "deploy": {"templateName": "watch"}}],
}


DETECTOR_SPEC: dict[str, Any] = {
    "streams": [{"name": "speed", "key": "vehicles/${client:*}/speed", "encoding": "json"}],
    "clientTimeout": "5s",
}


def test_a_vehicle_with_a_certificate_starts_an_application_and_others_are_rejected(
    node: Node, api: Api, image: str, helm: Helm, tmp_path: Path
) -> None:
    authority, foreign = Authority(tmp_path), Authority(tmp_path, "foreign")
    apply_certificates(api, authority)
    application = deployment("${instance.name}", image, ["python3", "-c", "import time; time.sleep(10**6)"])
    given = values(api.namespace, image, DETECTOR_SPEC) | {"eventRules": [{"name": "fast", "spec": RULE}]}
    given["crds"] = {"install": False}  # the node has the CRDs
    helm("install", RELEASE, str(CHART), "--namespace", api.namespace, values=given)
    lifecycle = {"linger": "0s", "minUptime": "0s"}
    template = {"apiVersion": "wayside.dev/v1alpha1", "kind": "ApplicationTemplate", "metadata": {"name": "watch"}}
    api.apply(template | {"spec": {"lifecycle": lifecycle, "manifests": [application]}})
    wait_installed(api)
    endpoint = router_endpoint(node, api)

    with vehicle(endpoint, authority.ca, authority.sign("car1")) as car:

        def is_ready() -> bool:
            car.put("vehicles/car2/speed", b'{"value": 40}')  # another vehicle's key
            car.put("vehicles/car1/speed", b'{"value": 40}')
            return any(task.get("status", {}).get("phase") == "Ready" for task in api.list("ApplicationTask"))

        wait_until(is_ready, bool, timeout=NODE_PATIENCE, what="the application that the speed requires is ready")
        assert api.find("Deployment", "watch") is not None
        requested = [task["spec"]["requester"]["subjects"] for task in api.list("ApplicationTask")]
        assert {name for subjects in requested for name in subjects} == {"car1"}

        def is_gone() -> bool:
            car.put("vehicles/car1/speed", b'{"value": 10}')
            return api.find("Deployment", "watch") is None

        wait_until(is_gone, bool, timeout=NODE_PATIENCE, what="the application is removed")

    mixed = authority.sign("car1")[0], authority.sign("car2")[1]
    for certificate in (None, foreign.sign("car1"), mixed):
        with pytest.raises(zenoh.ZError), vehicle(endpoint, authority.ca, certificate, patience=5):
            pass

    with vehicle(endpoint, authority.ca, authority.sign("unknown")):
        for reported in (
            "peer sent no certificates",
            "invalid peer certificate: UnknownIssuer",
            "did not match any configured ACL subject",
        ):
            wait_until(
                lambda: log_of(api, ROUTER),
                lambda log, reported=reported: reported in log,
                what=f"the log contains: {reported}",
            )


def log_of(api: Api, deployment: str) -> str:
    """The logs of the pods of a Deployment."""
    pods = [pod["metadata"]["name"] for pod in api.list("Pod") if pod["metadata"]["name"].startswith(f"{deployment}-")]
    return "".join(api.raw(f"/api/v1/namespaces/{api.namespace}/pods/{name}/log") for name in pods)
