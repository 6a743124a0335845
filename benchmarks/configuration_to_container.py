"""A changed configuration → seen in the running container, with and without the annotation that wakes the kubelet.

A real node, the manager as a pod, one application that reads its mounted file every 10 ms. From the request that
changes a task's parameter until the application has read the new value; both take the machine's clock. First with all
of the manager's rights, then without the one to patch pods: then the kubelet, with Kubernetes' own settings, finds the
new content by itself. Needs root. Exits with 1 where the median with the annotation misses its target.

    python -m benchmarks.configuration_to_container [--rounds 10] [--without 5]
"""

from __future__ import annotations

import argparse
import os
import random
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tests.cluster.api import Api, Object
from tests.cluster.crds import CRDS
from tests.cluster.namespaces import fresh_namespace
from tests.cluster.waiting import wait_until
from tests.e2e.images import WAYSIDE_IMAGE, wayside_archive
from tests.e2e.node import Node
from tests.e2e.wayside_in_cluster import apply_manager
from tests.e2e.workloads import deployment, wait_available

TARGET = 2.0  # s, median with the annotation
PATIENCE = 300.0  # s
NAME = "follower"
FOLLOW = """
import pathlib, time
file, last = pathlib.Path("/configuration/number"), None
while True:
    text = file.read_text()
    if text != last:
        print(text, time.time(), flush=True)
        last = text
    time.sleep(0.01)
"""


def main() -> int:
    """Measure and print; 1 means that the target was missed."""
    parser = argparse.ArgumentParser(prog="configuration_to_container", description=__doc__)
    parser.add_argument("--rounds", type=int, default=10, help="with the annotation (%(default)s)")
    parser.add_argument("--without", type=int, default=5, help="without it, about a minute each (%(default)s)")
    options = parser.parse_args()
    if os.geteuid() != 0:
        print("a real node needs root: not measured")
        return 0
    with Node(crds=CRDS, sync="1m") as node, tempfile.TemporaryDirectory() as folder:
        node.load(wayside_archive(Path(folder)))
        with fresh_namespace(node.api(), "configuration") as namespace:
            api = node.api(namespace)
            pod = start(api)
            numbers = iter(range(1, 10**6))
            with_it = [change(node, api, pod, next(numbers)) for _ in range(options.rounds)]
            forbid(api)
            without = [change(node, api, pod, next(numbers)) for _ in range(options.without)]
    for name, seconds in (("with the annotation", with_it), ("without it", without)):
        if seconds:
            figures = f"median {statistics.median(seconds):6.2f} s, worst {max(seconds):6.2f} s"
            print(f"change → container, {name:20} {figures} ({len(seconds)} rounds)")
    return 0 if statistics.median(with_it) <= TARGET else 1


def start(api: Api) -> Object:
    """Run the manager and one application; return the application's pod."""
    mount = {"volumeMounts": [{"name": "configuration", "mountPath": "/configuration"}]}
    volume = {"name": "configuration", "configMap": {"name": "${instance.configMap}"}}
    made = deployment(NAME, WAYSIDE_IMAGE, ["python3", "-c", FOLLOW], container=mount, volumes=[volume])
    api.apply(
        _object(
            "ApplicationTemplate",
            parameters={"number": {"type": "number", "default": 0, "merge": "Max"}},
            configuration={"number": "${parameters.number}"},
            manifests=[made],
        )
    )
    api.apply(_object("ApplicationTask", templateName=NAME, parameters={"number": 0}))
    apply_manager(api, WAYSIDE_IMAGE)
    wait_available(api, "application-manager")
    api.wait_for("Deployment", NAME, lambda _: True, timeout=PATIENCE, what="the application is created")
    return wait_available(api, NAME)


def change(node: Node, api: Api, pod: Object, number: int) -> float:
    """Seconds from the change of the task until the container has read the new number."""
    time.sleep(random.uniform(0.0, 1.0))
    began = time.time()
    api.patch("ApplicationTask", NAME, {"spec": {"parameters": {"number": number}}})
    logs = ("--namespace", api.namespace, "logs", "--tail=1", pod["metadata"]["name"])
    last = wait_until(
        lambda: node.plane.kubectl(*logs).split(),
        lambda logged: bool(logged) and float(logged[0]) == number,
        timeout=PATIENCE,
        what=f"the container has read {number}",
    )
    return float(last[1]) - began


def forbid(api: Api) -> None:
    """Remove only the right to patch pods from the manager."""
    for role in api.list("Role"):
        rules: list[dict[str, Any]] = []
        for rule in role["rules"]:
            of_pods = {**rule, "resources": ["pods"], "verbs": [verb for verb in rule["verbs"] if verb != "patch"]}
            others = {**rule, "resources": [each for each in rule["resources"] if each != "pods"]}
            rules += [others] if others["resources"] else []
            rules += [of_pods] if "pods" in rule["resources"] else []
        api.patch("Role", role["metadata"]["name"], {"rules": rules})


def _object(kind: str, **spec: Any) -> Object:
    return {"apiVersion": "wayside.dev/v1alpha1", "kind": kind, "metadata": {"name": NAME}, "spec": spec}


if __name__ == "__main__":
    sys.exit(main())
