"""Applications bound to nodes by their parameters, with a real scheduler; the nodes are objects without a kubelet."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from application_manager.core.claims.claims import instance_name
from tests.cluster.api import Api, Object
from tests.cluster.binaries import ensure_binaries
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import condition, deployment, start_manager, task, template, wait_settled
from tests.cluster.processes import Processes

SCHEDULER = "wayside-test"  # used by these tests only: no other pod is bound to their nodes
CONFIGURATION = """
apiVersion: kubescheduler.config.k8s.io/v1
kind: KubeSchedulerConfiguration
leaderElection: {leaderElect: false}
clientConnection: {kubeconfig: "%s"}
profiles: [{schedulerName: %s}]
"""


@pytest.fixture
def scheduler(control_plane: ControlPlane, processes: Processes) -> None:
    """A real kube-scheduler, for pods that set its schedulerName."""
    file = processes.folder / "scheduler.yaml"
    file.write_text(CONFIGURATION % (control_plane.kubeconfig, SCHEDULER))
    program = str(ensure_binaries().kube_scheduler)
    processes.start(program, f"--config={file}", "--secure-port=0")


@pytest.fixture
def nodes(api: Api) -> Iterator[list[str]]:
    """The nodes of two roadside units; the second has a taint."""
    names = [f"{each}-{api.namespace}"[:63] for each in ("rsu-1", "rsu-2")]
    for name, site in zip(names, ("north", "south"), strict=True):
        node(api, name, site, taints=[{"key": "edge", "effect": "NoSchedule"}] if site == "south" else [])
    yield names
    for name in names:
        api.delete("Node", name)


def node(api: Api, name: str, site: str, taints: list[Object]) -> None:
    labels = {"kubernetes.io/hostname": name, f"site-{api.namespace}": site}
    api.create(
        {"apiVersion": "v1", "kind": "Node", "metadata": {"name": name, "labels": labels}, "spec": {"taints": taints}}
    )
    api.patch("Node", name, {"spec": {"taints": taints}})  # without the taint not-ready, which each new node gets
    room = {"cpu": "4", "memory": "8Gi", "pods": "50"}
    api.patch("Node", name, {"status": {"capacity": room, "allocatable": room}}, subresource="status")


def placed(**pod: object) -> Object:
    """A template whose parameters place its pods."""
    made = deployment()
    made["spec"]["template"]["spec"] |= {"schedulerName": SCHEDULER, **pod}
    parameters = {
        "region": {"type": "string", "required": True},
        "node": {"type": "string"},
        "tolerate": {"type": "string", "default": "nothing", "merge": "HighestPriority"},
    }
    return template(parameters=parameters, manifests=[made])


def wait_bound(api: Api, region: str, node_name: str) -> None:
    api.wait_list(
        "Pod",
        lambda found: node_name in [each["spec"].get("nodeName") for each in found],
        labels=f"app={instance_name('app', region)}",
        what=f"a pod of {region} is on {node_name}",
    )


def wait_for_message(api: Api, name: str, *parts: str) -> Object:
    return api.wait_for(
        "ApplicationTask",
        name,
        lambda raw: (
            condition(raw, "Ready").get("reason") == "Unschedulable"
            and all(part in raw["status"].get("message", "") for part in parts)
        ),
        what=f"{name} reports {parts}",
    )


@pytest.mark.usefixtures("scheduler")
def test_a_task_places_its_application_on_the_named_node_and_a_missing_node_is_reported(
    api: Api, processes: Processes, namespace: str, nodes: list[str]
) -> None:
    start_manager(processes, namespace)
    api.create(placed(nodeSelector={"kubernetes.io/hostname": "${parameters.node}"}))
    api.create(task("north", node=nodes[0]))
    wait_bound(api, "north", nodes[0])
    api.create(task("west", node="rsu-9"))
    named = "fits no node: nodeSelector: no node has the label kubernetes.io/hostname=rsu-9"
    reported = wait_for_message(api, "west", named, "no node fits the pod")
    assert nodes[0] in reported["status"]["message"]  # the existing value
    api.wait_for(
        "ApplicationInstance",
        instance_name("app", "west"),
        lambda raw: condition(raw, "Ready").get("reason") == "Unschedulable",
        what="the instance reports it too",
    )
    api.patch("ApplicationTask", "west", {"spec": {"parameters": {"node": nodes[0]}}})
    wait_bound(api, "west", nodes[0])
    wait_settled(api)


@pytest.mark.usefixtures("scheduler")
def test_affinity_and_tolerations_come_from_parameters_too(
    api: Api, processes: Processes, namespace: str, nodes: list[str]
) -> None:
    start_manager(processes, namespace)
    at_site = {"key": f"site-{namespace}", "operator": "In", "values": ["${parameters.region}"]}
    required = {"nodeSelectorTerms": [{"matchExpressions": [at_site]}]}
    affinity = {"nodeAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": required}}
    api.create(placed(affinity=affinity, tolerations=[{"key": "${parameters.tolerate}", "operator": "Exists"}]))
    api.create(task("south"))
    wait_for_message(api, "south", "no node fits the pod", "untolerated taint")  # by the scheduler
    api.create(task("more", region="south", tolerate="edge"))
    wait_bound(api, "south", nodes[1])
    api.create(task("west"))
    wait_for_message(api, "west", f"no node has the label site-{namespace}=west (there are north, south)")
    node(api, f"rsu-3-{namespace}"[:63], "west", taints=[])
    try:
        wait_bound(api, "west", f"rsu-3-{namespace}"[:63])
    finally:
        api.delete("Node", f"rsu-3-{namespace}"[:63])


def test_a_missing_node_name_is_reported_without_a_scheduler(api: Api, processes: Processes, namespace: str) -> None:
    start_manager(processes, namespace)
    api.create(placed(nodeName="${parameters.node}"))
    api.create(task("north", node="rsu-9"))
    wait_for_message(api, "north", "nodeName: there is no node rsu-9")
