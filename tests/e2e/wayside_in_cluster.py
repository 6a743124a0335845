"""Both programs as pods, for the tests of the whole chain."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import condition
from tests.e2e.workloads import deployment, service, wait_available
from tests.patience import NODE_PATIENCE

EXAMPLE = Path(__file__).parents[2] / "examples" / "cooperative-recording"
ZENOH_PORT, METRICS_PORT = 7447, 9100
LATE = {"timeoutSeconds": 5}  # as in the chart; the default of a second is short on a busy machine
RESTRICTED = {  # the Pod Security Standard of this name
    "allowPrivilegeEscalation": False,
    "capabilities": {"drop": ["ALL"]},
    "readOnlyRootFilesystem": True,
    "runAsNonRoot": True,
    "seccompProfile": {"type": "RuntimeDefault"},
}


def apply_manager(api: Api, image: str) -> None:
    """Apply a manager of this namespace, with the rights that `application-manager rbac` prints."""
    api.apply({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": "application-manager"}})
    account = f"--account={api.namespace}/application-manager"
    rbac = [
        sys.executable,
        "-m",
        "application_manager.commands.cli",
        "rbac",
        f"--namespace={api.namespace}",
        account,
        "--detectors",
    ]
    for role in yaml.safe_load_all(subprocess.run(rbac, capture_output=True, text=True, check=True).stdout):
        api.apply(role)
    options = (f"--metrics-port={METRICS_PORT}", f"--detector-image={image}")
    command = ("application-manager", "run", "--namespace", api.namespace, *options)
    api.apply(_program("application-manager", image, command))


def run_town(api: Api, image: str) -> int:
    """Run the example's detector through a manager; return the node port of its Zenoh endpoint."""
    apply_manager(api, image)
    port = expose_detector(api, "town")
    wait_available(api, "application-manager")
    api.wait_for(
        "Detector",
        "town",
        lambda raw: condition(raw, "Running").get("status") == "True",
        timeout=NODE_PATIENCE,
        what="the manager runs the detector",
    )
    return port


def expose_detector(api: Api, name: str) -> int:
    """Expose the Zenoh endpoint of the named detector, which the manager runs; return the node port."""
    applied = api.apply(service("detector", ZENOH_PORT, type="NodePort", selector={"wayside.dev/runs": name}))
    return int(applied["spec"]["ports"][0]["nodePort"])


def apply_example(api: Api, image: str, command: list[str]) -> None:
    """Apply the cooperative-recording example, with a detector that the manager runs and vehicles can reach."""
    for document in example_documents(image, command):
        if document["kind"] == "Detector":
            document["spec"]["mode"] = "Standalone"
            document["spec"]["zenoh"]["listen"] = [f"tcp/0.0.0.0:{ZENOH_PORT}"]
        api.apply(document)


def example_documents(image: str, command: list[str]) -> Iterator[Object]:
    """The documents of the example's files, with other images and another namespace."""
    for file in ("templates.yaml", "rules.yaml", "detector.yaml"):
        for document in yaml.safe_load_all((EXAMPLE / file).read_text(encoding="utf-8")):
            document["metadata"].pop("namespace", None)
            for manifest in document["spec"].get("manifests", []):
                if manifest["kind"] == "Deployment":
                    (container,) = manifest["spec"]["template"]["spec"]["containers"]
                    container |= {"image": image, "imagePullPolicy": "Never", "command": command}
                    manifest["spec"]["template"]["spec"]["terminationGracePeriodSeconds"] = 1
            yield document


def _program(name: str, image: str, command: tuple[str, ...]) -> Object:
    field = {"fieldRef": {"fieldPath": "metadata.name"}}, {"fieldRef": {"fieldPath": "metadata.uid"}}
    container: dict[str, Any] = {
        "env": [{"name": "POD_NAME", "valueFrom": field[0]}, {"name": "POD_UID", "valueFrom": field[1]}],
        "ports": [{"containerPort": METRICS_PORT}],
        "readinessProbe": {"httpGet": {"path": "/readyz", "port": METRICS_PORT}, "periodSeconds": 1, **LATE},
        "livenessProbe": {"httpGet": {"path": "/healthz", "port": METRICS_PORT}, "initialDelaySeconds": 30, **LATE},
        "securityContext": RESTRICTED,
        "volumeMounts": [{"name": "scratch", "mountPath": "/tmp"}],
    }
    return deployment(
        name,
        image,
        command,
        container=container,
        serviceAccountName=name,
        volumes=[{"name": "scratch", "emptyDir": {}}],
        terminationGracePeriodSeconds=30,
    )
