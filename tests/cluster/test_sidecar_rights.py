"""Rights of sidecars: role bindings follow the Detector, and each pod may act only for itself."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from application_manager.core.objects.detectors import object_name, sidecar_roles
from application_manager.core.objects.rights import sidecar_rights
from tests import programs
from tests.cluster.api import Api
from tests.cluster.chain import CARS, FAR, HOLDER, NEAR, Vehicles
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import condition, start_manager
from tests.cluster.faulty_proxy import faulty_proxy
from tests.cluster.processes import Processes
from tests.cluster.sidecars import RUNS, create_accounts, event_of, pod, sidecar_detector, wait_injecting
from tests.cluster.test_manager_detectors import close_vehicles, detector, live
from tests.cluster.test_manager_rbac import ALLOWED, granted, may, printed, put, used, wait_in_force
from tests.cluster.waiting import wait_until
from tests.cluster.webhook import Webhook
from tests.patience import PATIENCE
from tests.ports import free_endpoint

NAME = object_name(HOLDER)


@pytest.fixture
def accounts(api: Api) -> None:
    create_accounts(api)


def test_role_bindings_follow_the_accounts_of_the_detector(
    api: Api, processes: Processes, namespace: str, control_plane: ControlPlane, accounts: None
) -> None:
    start_manager(processes, namespace, *RUNS)
    vehicle, other = (
        Api(control_plane.kubeconfig_of_service_account(namespace, name), namespace) for name in ("vehicle", "other")
    )

    def settles(*which: Api) -> None:
        for account in (vehicle, other):
            wanted = {True} if account in which else {False}
            wait_until(lambda account=account: answers(account), lambda found, w=wanted: found == w, what=f"{wanted}")

    def answers(account: Api) -> set[bool]:
        return {
            may(account, namespace, right.group, right.resource, verb, right.name)
            for right in sidecar_rights(HOLDER)
            for verb in right.verbs
        }

    settles()
    api.create(sidecar_detector("vehicle"))
    settles(vehicle)
    assert not may(vehicle, namespace, "wayside.dev", "detectors", "hold", HOLDER)
    assert not may(vehicle, namespace, "wayside.dev", "detectors", "hold-as-pod", "other")
    api.patch("Detector", HOLDER, {"spec": {"serviceAccountNames": ["other"]}})
    settles(other)
    api.patch("Detector", HOLDER, {"spec": {"serviceAccountNames": []}})
    settles()
    written = api.wait_for(
        "Detector",
        HOLDER,
        lambda raw: condition(raw, "Running").get("reason") == "NoAccounts",
        what="its status has the reason",
    )
    assert "spec.serviceAccountNames: is empty" in condition(written, "Running")["message"]
    # An account that is no longer listed has no rights, whether the rest of the Detector is valid or not.
    api.patch("Detector", HOLDER, {"spec": {"serviceAccountNames": ["vehicle"]}})
    settles(vehicle)
    wrong = detector()["spec"]["streams"][0] | {"stamp": "msg.t +"}
    api.patch("Detector", HOLDER, {"spec": {"serviceAccountNames": ["other"], "streams": [wrong]}})
    settles(other)
    api.wait_for(
        "Detector",
        HOLDER,
        lambda raw: condition(raw, "Running").get("reason") == "NotAccepted",
        what="its status has the reason",
    )


def test_changing_the_mode_removes_the_objects_of_the_old_mode(api: Api, processes: Processes, namespace: str) -> None:
    start_manager(processes, namespace, *RUNS)
    api.create(detector(mode="Standalone"))
    api.wait_for("Deployment", NAME, bool, what="it runs standalone")
    api.patch("Detector", HOLDER, {"spec": {"mode": "Sidecar", "serviceAccountNames": ["vehicle"]}})
    for kind in ("Deployment", "ServiceAccount"):
        api.wait_gone(kind, NAME)
    api.wait_for(
        "RoleBinding", NAME, lambda raw: raw["subjects"][0]["name"] == "vehicle", what="its accounts are bound"
    )
    api.patch("Detector", HOLDER, {"spec": {"mode": "Standalone", "serviceAccountNames": None}})
    api.wait_for("Deployment", NAME, bool, what="it runs standalone again")
    api.wait_for("RoleBinding", NAME, lambda raw: raw["subjects"][0]["name"] == NAME, what="its own account is bound")
    api.delete("Detector", HOLDER)
    for kind in ("Deployment", "ServiceAccount", "Role", "RoleBinding"):
        api.wait_gone(kind, NAME)


def test_the_printed_rights_suffice_to_inject_sidecars(
    api: Api, processes: Processes, namespace: str, control_plane: ControlPlane, tmp_path: Path, accounts: None
) -> None:
    api.create({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": "manager"}})
    account = control_plane.kubeconfig_of_service_account(namespace, "manager")
    manifests = printed("--namespace", namespace, "--account", f"{namespace}/manager", "--detectors", *ALLOWED)
    put(api, manifests)
    wait_in_force(account, namespace, manifests)
    webhook = Webhook(processes, api, tmp_path / "certificates", options=(*RUNS, *ALLOWED), kubeconfig=account)
    with webhook.requested():
        api.create(sidecar_detector("vehicle"))
        wait_injecting(api)
        api.create(pod(account="other"))
        event_of(api, "car", "has only vehicle")
    api.wait_for(
        "Detector",
        HOLDER,
        lambda raw: "1 without a detector" in condition(raw, "Running").get("message", ""),
        what="the manager has seen the pod without a sidecar",
    )
    assert webhook.manager.terminate() == 0
    assert "orbidden" not in webhook.manager.output()
    assert "service account cannot" not in webhook.manager.output()


def test_a_sidecar_acts_for_its_own_pod_only_and_needs_exactly_its_rights(
    api: Api, processes: Processes, namespace: str, control_plane: ControlPlane, accounts: None, tmp_path: Path
) -> None:
    roles = sidecar_roles(namespace, HOLDER, ["vehicle"])
    put(api, roles)
    account = control_plane.kubeconfig_of_service_account(namespace, "vehicle")
    wait_in_force(account, namespace, roles)
    endpoint = free_endpoint()
    api.create(sidecar_detector("vehicle", zenoh={"mode": "peer", "listen": [endpoint]}))
    api.create(close_vehicles())
    uid = api.create(pod())["metadata"]["uid"]
    holder = f"{HOLDER}.car"
    with faulty_proxy(account) as (proxy, kubeconfig):
        environment = {"KUBECONFIG": str(kubeconfig), "POD_NAME": "car", "POD_UID": uid}
        options = ("--name", HOLDER, "--namespace", namespace, "--as-pod")
        running = processes.start("detector", "run", *options, environment=environment)
        running.wait_for_output(f"Detector {HOLDER} runs with 1 rules")
        with Vehicles(endpoint) as vehicles:
            vehicles.place(CARS, NEAR)
            (task,) = api.wait_list("ApplicationTask", lambda found: len(live(found)) == 1, what="a task exists")
            vehicles.place(CARS, FAR)
            api.wait_list("ApplicationTask", lambda found: bool(found) and not live(found), what="the task has ended")
        assert status_of(tmp_path, endpoint) == [holder]
        assert task["spec"]["requester"]["holder"] == holder
        assert task["spec"]["requester"]["detectorName"] == HOLDER
        lease = api.get("Lease", f"wayside-{holder}")
        assert [each["uid"] for each in lease["metadata"]["ownerReferences"]] == [uid]
        api.wait_for(
            "Lease",
            f"wayside-{holder}",
            lambda raw: raw["spec"]["renewTime"] != lease["spec"]["renewTime"],
            what="its Lease is renewed",
        )
        assert running.terminate() == 0
        requested = set(used(proxy.seen, namespace))
    assert requested <= granted(roles)
    seldom = {("applicationtasks", "get"), ("applicationtasks", "delete"), ("detectors", "hold-as-pod")}
    assert {(resource, verb) for _, resource, verb in granted(roles) - requested} <= seldom


def status_of(folder: Path, endpoint: str) -> list[str]:
    """The holders that answer `detector status` about the Detector of the file, which names no pod."""
    (file := folder / "detector.yaml").write_text(
        yaml.safe_dump(sidecar_detector("vehicle", zenoh={"mode": "peer", "listen": [endpoint]}))
    )
    done = programs.run("detector", "status", "--detector", file, "--json", "--timeout", str(PATIENCE / 4), check=True)
    return [json.loads(line)["holder"] for line in done.stdout.splitlines()]
