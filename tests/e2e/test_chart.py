"""The chart on a node without Wayside: the installed release serves vehicles, and its uninstall leaves no objects."""

from __future__ import annotations

import copy
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.certificates import Authority
from tests.cluster.api import Api, ApiError, Object, Objects
from tests.cluster.crds import CRD_NAMES, apply_crds, remove_crds, wait_crd_gone, wait_garbage_collected
from tests.cluster.waiting import wait_until
from tests.e2e.inventory import inventory, wait_left
from tests.e2e.node import Node
from tests.e2e.released import (
    DETECTOR,
    MANAGER,
    RELEASE,
    ROUTER,
    apply_certificates,
    available,
    router_endpoint,
    values,
    vehicle,
    wait_installed,
)
from tests.e2e.test_cooperative_recording import REPORT, applications, ready, wait_pods
from tests.e2e.wayside_in_cluster import EXAMPLE, example_documents
from tests.helm.wayside_chart import CHART, Helm
from tests.patience import NODE_PATIENCE

sys.path.insert(0, str(EXAMPLE))

from cooperative_recording.parked import ParkedVehicles
from cooperative_recording.vehicles import LIDAR_VEHICLES

DETECTOR_SPEC = yaml.safe_load((EXAMPLE / "detector.yaml").read_text(encoding="utf-8"))["spec"]
AS_THE_GUIDE = ("--wait", "--timeout", "5m")
"""`--wait` lets the API server serve the CRDs before a hook creates the Detectors of the values."""
WRONG: Object = {
    "apiVersion": "wayside.dev/v1alpha1",
    "kind": "ApplicationTemplate",
    "metadata": {"name": "wrong"},
    "spec": {"manifests": [{"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "${there.is.none}"}}]},
}


@pytest.fixture
def api_without_crds(node: Node, api: Api) -> Iterator[Api]:
    """The test's namespace, under the restricted Pod Security Standard, on a node without Wayside's CRDs."""
    remove_crds(api, CRD_NAMES)
    api.patch(
        "Namespace", api.namespace, {"metadata": {"labels": {"pod-security.kubernetes.io/enforce": "restricted"}}}
    )
    api.wait_for("ConfigMap", "kube-root-ca.crt", lambda _: True, what="the namespace has the ConfigMap of the root CA")
    yield node.api(api.namespace)
    remove_crds(api, CRD_NAMES)
    apply_crds(api)


def release_pods(api: Api, name: str) -> Objects:
    """The pods of the detector, or of another Deployment of the release."""
    label = f"wayside.dev/runs={name.removeprefix('detector-')}" if name == DETECTOR else (
        f"app.kubernetes.io/component={name.removeprefix(f'{RELEASE}-')}"
    )  # fmt: skip
    return api.list("Pod", labels=label)


def uids_and_restarts(pods: Objects) -> list[tuple[str, int]]:
    """The uid of each pod and the number of restarts of its containers."""
    return [
        (pod["metadata"]["uid"], sum(each["restartCount"] for each in pod["status"].get("containerStatuses", [])))
        for pod in pods
    ]


def test_the_example_from_nothing_by_mutual_tls_through_an_upgrade_until_nothing_is_left(
    node: Node, api_without_crds: Api, image: str, helm: Helm, tmp_path: Path
) -> None:
    api, authority = api_without_crds, Authority(tmp_path)
    before = inventory(node)
    apply_certificates(api, authority)
    given = copy.deepcopy(values(api.namespace, image, DETECTOR_SPEC))
    given["manager"]["ttlAfterFinished"] = "1s"
    first, second = (each.name for each in LIDAR_VEHICLES[:2])
    given["router"]["accessControl"]["clients"][0]["commonNames"] = [first, second]
    where = ("--namespace", api.namespace)
    helm("install", RELEASE, str(CHART), *where, *AS_THE_GUIDE, values=given)
    wait_installed(api)
    helm("test", RELEASE, *where, "--timeout", "5m")
    with pytest.raises(ApiError, match=r"not declared|there"):
        api.create(WRONG)

    example = [each for each in example_documents(image, ["python3", "-c", REPORT]) if each["kind"] != "Detector"]
    for document in example:
        api.apply(document)
    endpoint = router_endpoint(node, api)
    one, other = (ParkedVehicles(vehicle(endpoint, authority.ca, authority.sign(name))) for name in (first, second))
    with one, other:  # each certificate permits only the vehicle's own keys
        one.put(first, 0)
        other.put(second, 100)
        (recorder,) = wait_pods(api, "scene-recorder", ready, "the recorder of the two runs")
        (fusion,) = wait_pods(api, "scene-fusion", ready, "the fusion of their scene runs")
        assert f"--key=vehicles/{first}/** --key=vehicles/{second}/** --output=/recording" in logged(node, recorder)
        reported = wait_until(lambda: logged(node, fusion), lambda text: first in text, what="it has the sources")
        assert reported.count(first) == 1, "once"

        running = uids_and_restarts([*applications(api, "scene-recorder"), *applications(api, "scene-fusion")])
        serving = uids_and_restarts([*release_pods(api, DETECTOR), *release_pods(api, ROUTER)])
        changed = copy.deepcopy(given)
        changed["manager"] |= {"replicas": 2, "podAnnotations": {"example.com/changed": "yes"}}
        helm("upgrade", RELEASE, str(CHART), *where, values=changed)
        api.wait_for(
            "Deployment",
            MANAGER,
            lambda found: available(found) and found["status"].get("readyReplicas") == 2,
            timeout=NODE_PATIENCE,
            what="two managers of the new version are ready",
        )
        assert uids_and_restarts([*applications(api, "scene-recorder"), *applications(api, "scene-fusion")]) == running
        assert uids_and_restarts([*release_pods(api, DETECTOR), *release_pods(api, ROUTER)]) == serving

        other.put(second, 1000)  # the new manager acts on it
        wait_pods(api, "scene-recorder", lambda pods: not pods, "the recorder is removed")
        wait_pods(api, "scene-fusion", lambda pods: not pods, "the fusion is removed")
    api.wait_list("ApplicationTask", lambda found: not found, timeout=NODE_PATIENCE, what="the tasks are deleted")

    for document in example:
        api.delete(document["kind"], document["metadata"]["name"])
    for name in ("router-tls", "town-tls"):
        api.delete("Secret", name)
    helm("uninstall", RELEASE, *where)
    left = wait_left(node, before, {"CustomResourceDefinition"}, NODE_PATIENCE)
    assert {name for _, _, name in left} == CRD_NAMES, "the CRDs are kept"


def logged(node: Node, pod: Object) -> str:
    """The log of the pod, once it is not empty."""
    metadata = pod["metadata"]
    log = ("--namespace", metadata["namespace"], "logs", metadata["name"])
    return wait_until(lambda: node.plane.kubectl(*log), bool, what=f"pod {metadata['name']} has written to its log")


@pytest.mark.parametrize("keep", [True, False])
def test_a_release_that_was_never_upgraded_leaves_no_detector_behind(
    node: Node, api_without_crds: Api, image: str, helm: Helm, tmp_path: Path, keep: bool
) -> None:
    api = api_without_crds
    before = inventory(node)
    apply_certificates(api, Authority(tmp_path))
    given = values(api.namespace, image, DETECTOR_SPEC) | {"crds": {"keep": keep}}
    helm("install", RELEASE, str(CHART), "--namespace", api.namespace, *AS_THE_GUIDE, values=given)
    wait_installed(api)
    if not keep:
        wait_garbage_collected(api)
    helm("uninstall", RELEASE, "--namespace", api.namespace)
    for name in ("router-tls", "town-tls"):
        api.delete("Secret", name)
    for name in () if keep else CRD_NAMES:
        wait_crd_gone(api, name)
    wait_left(node, before, {"CustomResourceDefinition"} if keep else set(), NODE_PATIENCE)
