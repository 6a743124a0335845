"""Pods that ask for a detector get it on their way through a real API server, and are made without it in any case."""

from __future__ import annotations

import copy
import json
import os
import signal
import subprocess
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from application_manager.core.objects.detectors import object_name, sidecar_roles
from application_manager.core.objects.rights import sidecar_rights
from application_manager.core.objects.sidecars import CONTAINER
from tests import programs
from tests.cluster.api import Api, Object
from tests.cluster.chain import CARS, FAR, HOLDER, NEAR, Vehicles
from tests.cluster.controlplane import ControlPlane
from tests.cluster.faulty_proxy import faulty_proxy
from tests.cluster.managed_world import condition, start_manager
from tests.cluster.processes import BIN, Processes
from tests.cluster.test_manager_detectors import close_vehicles, detector, live
from tests.cluster.test_manager_rbac import ALLOWED, granted, may, printed, put, used, wait_in_force
from tests.cluster.waiting import wait_until
from tests.cluster.webhook import Webhook
from tests.ports import free_endpoint, free_port

IMAGE = "wayside:1"
RUNS = ("--detector-image", IMAGE)
NAME = object_name(HOLDER)
LABELS = {"wayside.dev/detector": HOLDER}


def sidecar_detector(*accounts: str, **spec: Any) -> Object:
    return detector(mode="Sidecar", serviceAccountNames=list(accounts), **spec)


def pod(name: str = "car", account: str = "vehicle", **spec: Any) -> Object:
    main = {"name": "main", "image": "app:1"}
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {"name": name, "labels": dict(LABELS)},
        "spec": {"serviceAccountName": account, "containers": [main], **spec},
    }


def sidecars(raw: Object) -> list[Object]:
    return [each for each in raw["spec"].get("initContainers", []) if each["name"] == CONTAINER]


@pytest.fixture
def accounts(api: Api) -> None:
    for name in ("vehicle", "other"):
        api.create({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": name}})


@pytest.fixture
def webhook(api: Api, processes: Processes, tmp_path: Path, accounts: None) -> Webhook:
    return Webhook(processes, api, tmp_path / "certificates", options=RUNS)


@pytest.fixture
def asked(webhook: Webhook, api: Api) -> Iterator[Webhook]:
    """The API server asks about pods; a Detector is there for the account `vehicle`."""
    api.create(sidecar_detector("vehicle"))
    with webhook.asked():
        wait_injecting(api)
        yield webhook


def wait_injecting(api: Api) -> None:
    wait_until(
        lambda: sidecars(api.apply(pod("probe"), dry_run=True)),
        lambda found: len(found) == 1,
        what="pods are asked about",
    )


def event_of(api: Api, name: str, part: str) -> Object:
    """The Event about the pod whose note has the part."""

    def about(found: list[Object]) -> list[Object]:
        return [
            each
            for each in found
            if (each["involvedObject"]["kind"], each["involvedObject"]["name"]) == ("Pod", name)
            and part in each["message"]
        ]

    found = about(api.wait_list("Event", lambda found: bool(about(found)), what=f"an Event of pod {name} has: {part}"))
    assert len(found) == 1
    assert (found[0]["reason"], found[0]["type"]) == ("NotInjected", "Warning")
    assert found[0]["involvedObject"]["uid"] == api.get("Pod", name)["metadata"]["uid"]
    return found[0]


def injected(
    control_plane: ControlPlane, namespace: str, *files: Path, given: str | None = None
) -> tuple[int, str, str]:
    """What `application-manager inject` says: the exit code, stdout and stderr."""
    done = subprocess.run(
        [
            str(BIN / "application-manager"),
            "inject",
            "-n",
            namespace,
            *RUNS,
            *(w for f in files for w in ("-f", str(f))),
        ]
        + ([] if given is None else ["-f", "-"]),
        input=given,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"KUBECONFIG": str(control_plane.kubeconfig)},
    )
    return done.returncode, done.stdout, done.stderr


def test_a_pod_that_asks_gets_the_detector_once_and_as_the_command_prints_it(
    api: Api, asked: Webhook, namespace: str, control_plane: ControlPlane
) -> None:
    made = api.create(pod())
    (mine,) = sidecars(made)
    assert (mine["restartPolicy"], mine["image"]) == ("Always", IMAGE)

    code, text, said = injected(control_plane, namespace, given=json.dumps(pod("by-hand")))
    assert (code, said) == (0, "")
    by_hand = api.create(yaml.safe_load(text))
    for field in ("initContainers", "volumes"):
        assert without_token(by_hand["spec"][field]) == without_token(made["spec"][field])

    again = copy.deepcopy(made)
    again["metadata"] = {"name": "again", "labels": dict(LABELS)}
    for gone in ("nodeName", "status"):
        again["spec"].pop(gone, None)
    assert len(sidecars(api.create(again))) == 1

    unlabelled = pod("unlabelled")
    del unlabelled["metadata"]["labels"]
    assert not sidecars(api.create(unlabelled))
    message = "it runs in 0 of 3 pods with its label"
    api.wait_for("Detector", HOLDER, lambda raw: condition(raw, "Running").get("message") == message, what=message)


def without_token(items: list[Object]) -> list[Object]:
    """Without what Kubernetes itself adds under a name that it makes up."""
    return [each for each in items if not each["name"].startswith("kube-api-access-")]


def test_a_second_webhook_that_is_asked_about_the_same_pod_adds_nothing(
    api: Api, processes: Processes, tmp_path: Path, accounts: None
) -> None:
    metrics = free_port()
    options = (*RUNS, "--metrics-port", str(metrics))
    webhook = Webhook(processes, api, tmp_path / "certificates", options=options)
    api.create(sidecar_detector("vehicle"))
    other = copy.deepcopy(webhook.injection)
    other["metadata"]["name"] += "-again"
    other["webhooks"][0]["name"] = "again.wayside.dev"
    with webhook.asked():
        api.apply(other)
        try:

            def asked_how_often() -> int:
                before = asked_about_pods(metrics)
                made = api.apply(pod("probe"), dry_run=True)
                names = [each["name"] for each in made["spec"].get("volumes", [])]
                assert (len(set(names)), len(sidecars(made))) == (len(names), min(len(sidecars(made)), 1))
                return asked_about_pods(metrics) - before if sidecars(made) else 0

            wait_until(asked_how_often, lambda found: found == 2, what="it is asked twice, and the pod has it once")
        finally:
            api.delete("MutatingWebhookConfiguration", other["metadata"]["name"])


def asked_about_pods(port: int) -> int:
    """How many questions about pods the manager has answered."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=30) as response:
        lines = response.read().decode().splitlines()
    name = 'wayside_manager_reviews_total{answer="'
    return sum(int(float(each.split()[-1])) for each in lines if each.startswith(name) and 'kind="Pod"' in each)


def test_a_deployments_pods_get_it_however_they_are_made(api: Api, asked: Webhook) -> None:
    template = pod()
    api.create(
        {
            "apiVersion": "apps/v1",
            "kind": "Deployment",
            "metadata": {"name": "cars"},
            "spec": {
                "replicas": 2,
                "selector": {"matchLabels": LABELS},
                "template": {"metadata": {"labels": LABELS}, "spec": template["spec"]},
            },
        }
    )
    api.wait_list("Pod", lambda found: sum(len(sidecars(each)) for each in found) == 2, what="both pods have it")
    assert not api.get("Deployment", "cars")["spec"]["template"]["spec"].get("initContainers")


def test_a_pod_that_cannot_have_it_is_made_and_its_event_says_why(api: Api, asked: Webhook) -> None:
    lost = pod("lost")
    lost["metadata"]["labels"] = {"wayside.dev/detector": "nowhere"}
    for each in (lost, pod("foreign", account="other")):
        assert not sidecars(api.create(each))
    event_of(api, "lost", f"namespace {api.namespace} has no valid Detector 'nowhere': create or correct it")
    event_of(api, "foreign", f"serviceAccountNames of Detector {HOLDER} has only vehicle, not other: add it")

    api.patch("Detector", HOLDER, {"spec": {"mode": "Standalone", "serviceAccountNames": None}})
    # The manager learns of a change by its watch, a moment later.
    wait_until(
        lambda: sidecars(api.apply(pod("probe"), dry_run=True)),
        lambda injected: not injected,
        what="the manager knows that the Detector is Standalone",
    )
    assert not sidecars(api.create(pod("late")))
    event_of(api, "late", "is of mode Standalone: give it mode Sidecar")


def test_a_detector_that_was_applied_a_moment_before_its_pod_is_found(api: Api, asked: Webhook) -> None:
    for number in range(5):
        name = f"town-{number}"
        fresh = sidecar_detector("vehicle")
        fresh["metadata"] = {"name": name}
        one = pod(f"car-{number}")
        one["metadata"]["labels"] = {"wayside.dev/detector": name}
        api.create(fresh)
        assert len(sidecars(api.create(one))) == 1


def test_a_manager_that_hangs_or_is_gone_keeps_no_pod_from_being_made(
    api: Api, processes: Processes, tmp_path: Path, accounts: None
) -> None:
    api.create(sidecar_detector("vehicle"))
    webhook = Webhook(processes, api, tmp_path / "certificates", patience=2, options=RUNS)
    with webhook.asked():
        wait_injecting(api)
        os.kill(webhook.manager.pid, signal.SIGSTOP)
        assert not sidecars(api.create(pod("while-it-hangs")))
        os.kill(webhook.manager.pid, signal.SIGCONT)
        webhook.manager.kill9()
        assert not sidecars(api.create(pod("while-it-is-gone")))
        webhook.manager.start()
        for name in ("while-it-hangs", "while-it-is-gone"):
            event_of(api, name, "it was created before its Detector, or while no webhook was available")


def test_an_event_is_not_told_again_by_the_next_manager(
    api: Api, processes: Processes, namespace: str, webhook: Webhook
) -> None:
    api.create(pod())
    event_of(api, "car", "has no Detector")
    assert webhook.manager.terminate() == 0
    start_manager(processes, namespace, *RUNS)
    api.create(pod("second"))
    event_of(api, "second", "has no Detector")
    event_of(api, "car", "has no Detector")


def test_bindings_follow_the_accounts_that_the_detector_names(
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
    said = api.wait_for(
        "Detector", HOLDER, lambda raw: condition(raw, "Running").get("reason") == "NoAccounts", what="it says so"
    )
    assert "spec.serviceAccountNames is empty" in condition(said, "Running")["message"]
    # Who is named no more has no rights any more, be the rest of the Detector right or wrong.
    api.patch("Detector", HOLDER, {"spec": {"serviceAccountNames": ["vehicle"]}})
    settles(vehicle)
    wrong = detector()["spec"]["streams"][0] | {"stamp": "msg.t +"}
    api.patch("Detector", HOLDER, {"spec": {"serviceAccountNames": ["other"], "streams": [wrong]}})
    settles(other)
    api.wait_for(
        "Detector", HOLDER, lambda raw: condition(raw, "Running").get("reason") == "NotAccepted", what="it says so"
    )


def test_what_one_mode_needs_goes_with_the_change_to_the_other(api: Api, processes: Processes, namespace: str) -> None:
    start_manager(processes, namespace, *RUNS)
    api.create(detector(mode="Standalone"))
    api.wait_for("Deployment", NAME, bool, what="it runs by itself")
    api.patch("Detector", HOLDER, {"spec": {"mode": "Sidecar", "serviceAccountNames": ["vehicle"]}})
    for kind in ("Deployment", "ServiceAccount"):
        api.wait_gone(kind, NAME)
    api.wait_for(
        "RoleBinding", NAME, lambda raw: raw["subjects"][0]["name"] == "vehicle", what="its accounts are bound"
    )
    api.patch("Detector", HOLDER, {"spec": {"mode": "Standalone", "serviceAccountNames": None}})
    api.wait_for("Deployment", NAME, bool, what="it runs by itself again")
    api.wait_for("RoleBinding", NAME, lambda raw: raw["subjects"][0]["name"] == NAME, what="its own account is bound")
    api.delete("Detector", HOLDER)
    for kind in ("Deployment", "ServiceAccount", "Role", "RoleBinding"):
        api.wait_gone(kind, NAME)


def test_the_manager_puts_it_into_pods_with_the_rights_that_are_printed(
    api: Api, processes: Processes, namespace: str, control_plane: ControlPlane, tmp_path: Path, accounts: None
) -> None:
    api.create({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": "manager"}})
    account = control_plane.kubeconfig_of_service_account(namespace, "manager")
    manifests = printed("--namespace", namespace, "--account", f"{namespace}/manager", "--detectors", *ALLOWED)
    put(api, manifests)
    wait_in_force(account, namespace, manifests)
    webhook = Webhook(processes, api, tmp_path / "certificates", options=(*RUNS, *ALLOWED), kubeconfig=account)
    with webhook.asked():
        api.create(sidecar_detector("vehicle"))
        wait_injecting(api)
        api.create(pod(account="other"))
        event_of(api, "car", "has only vehicle")
    api.wait_for(
        "Detector", HOLDER, lambda raw: condition(raw, "Running").get("reason") == "InPods", what="it runs in pods"
    )
    assert webhook.manager.terminate() == 0
    assert "orbidden" not in webhook.manager.output()
    assert "may not" not in webhook.manager.output()


def test_in_a_pod_it_holds_for_this_pod_alone_and_needs_its_rights_and_no_more(
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
            (task,) = api.wait_list("ApplicationTask", lambda found: len(live(found)) == 1, what="there is a task")
            vehicles.place(CARS, FAR)
            api.wait_list("ApplicationTask", lambda found: bool(found) and not live(found), what="the task has ended")
        assert status_of(tmp_path, endpoint) == [holder]
        assert task["spec"]["requester"]["holder"] == holder
        assert task["spec"]["requester"]["detector"] == HOLDER
        lease = api.get("Lease", f"wayside-{holder}")
        assert [each["uid"] for each in lease["metadata"]["ownerReferences"]] == [uid]
        api.wait_for(
            "Lease",
            f"wayside-{holder}",
            lambda raw: raw["spec"]["renewTime"] != lease["spec"]["renewTime"],
            what="its Lease is renewed",
        )
        assert running.terminate() == 0
        asked = set(used(proxy.seen, namespace))
    assert asked <= granted(roles)
    seldom = {("applicationtasks", "get"), ("applicationtasks", "delete"), ("detectors", "hold-as-pod")}
    assert {(resource, verb) for _, resource, verb in granted(roles) - asked} <= seldom


def status_of(folder: Path, endpoint: str) -> list[str]:
    """The holders that answer `detector status` about the Detector of the file, which names no pod."""
    (file := folder / "detector.yaml").write_text(
        yaml.safe_dump(sidecar_detector("vehicle", zenoh={"mode": "peer", "listen": [endpoint]}))
    )
    done = programs.run("detector", "status", "--detector", file, "--json", "--timeout", "30", check=True)
    return [json.loads(line)["holder"] for line in done.stdout.splitlines()]


def test_what_the_command_cannot_do_is_said_and_the_rest_is_printed(
    api: Api, control_plane: ControlPlane, namespace: str, tmp_path: Path
) -> None:
    (file := tmp_path / "detector.yaml").write_text(yaml.safe_dump(sidecar_detector("vehicle")))
    cron = {"jobTemplate": {"spec": {"template": {"metadata": {"labels": LABELS}, "spec": pod()["spec"]}}}}
    job = {"apiVersion": "batch/v1", "kind": "CronJob", "metadata": {"name": "nightly"}, "spec": cron}
    documents = [
        job,
        pod("foreign", account="other"),
        {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "c"}},
    ]
    code, text, said = injected(control_plane, namespace, file, given=yaml.safe_dump_all(documents))
    nightly, foreign, config = yaml.safe_load_all(text)
    assert len(sidecars(nightly["spec"]["jobTemplate"]["spec"]["template"])) == 1
    assert [foreign, config] == documents[1:]
    why = f"spec.serviceAccountName: serviceAccountNames of Detector {HOLDER} has only vehicle, not other: add it"
    assert (code, said) == (1, f"Pod foreign: {why}\n")
    code, _, said = injected(control_plane, namespace, given=yaml.safe_dump(pod()))
    assert (code, "has no Detector 'town' that can be read: create it" in said) == (1, True)
