"""A real API server injects the detector into pods that request it, and creates pods without it on any failure."""

from __future__ import annotations

import copy
import json
import os
import signal
import subprocess
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.cluster.api import Api, Object
from tests.cluster.chain import HOLDER
from tests.cluster.controlplane import ControlPlane
from tests.cluster.expected_objects import condition, start_manager
from tests.cluster.processes import BIN, Processes
from tests.cluster.sidecars import (
    IMAGE,
    LABELS,
    RUNS,
    create_accounts,
    event_of,
    pod,
    sidecar_detector,
    sidecars,
    wait_injecting,
)
from tests.cluster.waiting import wait_until
from tests.cluster.webhook import Webhook
from tests.patience import PATIENCE
from tests.ports import free_port


@pytest.fixture
def accounts(api: Api) -> None:
    create_accounts(api)


@pytest.fixture
def webhook(api: Api, processes: Processes, tmp_path: Path, accounts: None) -> Webhook:
    return Webhook(processes, api, tmp_path / "certificates", options=RUNS)


@pytest.fixture
def requested(webhook: Webhook, api: Api) -> Iterator[Webhook]:
    """The API server calls the webhook for pods; a Detector exists for the account `vehicle`."""
    api.create(sidecar_detector("vehicle"))
    with webhook.requested():
        wait_injecting(api)
        yield webhook


def injected(
    control_plane: ControlPlane, namespace: str, *files: Path, given: str | None = None
) -> tuple[int, str, str]:
    """The result of `application-manager inject`: the exit code, stdout and stderr."""
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


def test_a_pod_that_requests_a_detector_gets_it_once_and_as_the_command_prints_it(
    api: Api, requested: Webhook, namespace: str, control_plane: ControlPlane
) -> None:
    made = api.create(pod())
    (mine,) = sidecars(made)
    assert (mine["restartPolicy"], mine["image"]) == ("Always", IMAGE)

    code, text, logged = injected(control_plane, namespace, given=json.dumps(pod("by-hand")))
    assert (code, logged) == (0, "")
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
    """The pod without the parts that Kubernetes adds under generated names."""
    return [each for each in items if not each["name"].startswith("kube-api-access-")]


def test_a_second_webhook_call_for_the_same_pod_adds_nothing(
    api: Api, processes: Processes, tmp_path: Path, accounts: None
) -> None:
    metrics = free_port()
    options = (*RUNS, "--metrics-port", str(metrics))
    webhook = Webhook(processes, api, tmp_path / "certificates", options=options)
    api.create(sidecar_detector("vehicle"))
    other = copy.deepcopy(webhook.injection)
    other["metadata"]["name"] += "-again"
    other["webhooks"][0]["name"] = "again.wayside.dev"
    with webhook.requested():
        api.apply(other)
        try:

            def number_of_reviews() -> int:
                before = reviews_of_pods(metrics)
                made = api.apply(pod("probe"), dry_run=True)
                names = [each["name"] for each in made["spec"].get("volumes", [])]
                assert (len(set(names)), len(sidecars(made))) == (len(names), min(len(sidecars(made)), 1))
                return reviews_of_pods(metrics) - before if sidecars(made) else 0

            wait_until(
                number_of_reviews,
                lambda found: found == 2,
                what="the webhook is called twice, and the pod has one sidecar",
            )
        finally:
            api.delete("MutatingWebhookConfiguration", other["metadata"]["name"])


def reviews_of_pods(port: int) -> int:
    """The number of reviews of pods that the manager has answered."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE) as response:
        lines = response.read().decode().splitlines()
    name = 'wayside_manager_reviews_total{answer="'
    return sum(int(float(each.split()[-1])) for each in lines if each.startswith(name) and 'kind="Pod"' in each)


def test_pods_of_a_deployment_get_the_detector(api: Api, requested: Webhook) -> None:
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
    api.wait_list(
        "Pod", lambda found: sum(len(sidecars(each)) for each in found) == 2, what="both pods have the sidecar"
    )
    assert not api.get("Deployment", "cars")["spec"]["template"]["spec"].get("initContainers")


def test_a_pod_that_cannot_get_a_detector_is_created_with_an_event_that_gives_the_reason(
    api: Api, requested: Webhook
) -> None:
    lost = pod("lost")
    lost["metadata"]["labels"] = {"wayside.dev/detector": "nowhere"}
    for each in (lost, pod("foreign", account="other")):
        assert not sidecars(api.create(each))
    event_of(api, "lost", f"namespace {api.namespace} has no valid Detector 'nowhere': create or correct it")
    event_of(api, "foreign", f"serviceAccountNames of Detector {HOLDER} has only vehicle, not other: add it")

    api.patch("Detector", HOLDER, {"spec": {"mode": "Standalone", "serviceAccountNames": None}})
    # The manager's watch reports the change a moment later.
    wait_until(
        lambda: sidecars(api.apply(pod("probe"), dry_run=True)),
        lambda injected: not injected,
        what="the manager has seen that the Detector is Standalone",
    )
    assert not sidecars(api.create(pod("late")))
    event_of(api, "late", "has mode Standalone: give it mode Sidecar")


def test_a_detector_applied_just_before_its_pod_is_found(api: Api, requested: Webhook) -> None:
    for number in range(5):
        name = f"town-{number}"
        fresh = sidecar_detector("vehicle")
        fresh["metadata"] = {"name": name}
        one = pod(f"car-{number}")
        one["metadata"]["labels"] = {"wayside.dev/detector": name}
        api.create(fresh)
        assert len(sidecars(api.create(one))) == 1


def test_pods_start_without_a_manager(api: Api, processes: Processes, tmp_path: Path, accounts: None) -> None:
    api.create(sidecar_detector("vehicle"))
    webhook = Webhook(processes, api, tmp_path / "certificates", patience=2, options=RUNS)
    with webhook.requested():
        wait_injecting(api)
        os.kill(webhook.manager.pid, signal.SIGSTOP)
        assert not sidecars(api.create(pod("while-it-hangs")))
        os.kill(webhook.manager.pid, signal.SIGCONT)
        webhook.manager.kill9()
        assert not sidecars(api.create(pod("while-it-is-gone")))
        webhook.manager.start()
        for name in ("while-it-hangs", "while-it-is-gone"):
            event_of(api, name, "it was created before its Detector, or while no webhook was available")


def test_an_event_is_not_reported_again_by_the_next_manager(
    api: Api, processes: Processes, namespace: str, webhook: Webhook
) -> None:
    api.create(pod())
    event_of(api, "car", "has no valid Detector")
    assert webhook.manager.terminate() == 0
    start_manager(processes, namespace, *RUNS)
    api.create(pod("second"))
    event_of(api, "second", "has no valid Detector")
    event_of(api, "car", "has no valid Detector")


def test_the_command_reports_pods_it_cannot_inject_and_prints_the_rest(
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
    code, text, logged = injected(control_plane, namespace, file, given=yaml.safe_dump_all(documents))
    nightly, foreign, config = yaml.safe_load_all(text)
    assert len(sidecars(nightly["spec"]["jobTemplate"]["spec"]["template"])) == 1
    assert [foreign, config] == documents[1:]
    why = f"spec.serviceAccountName: serviceAccountNames of Detector {HOLDER} has only vehicle, not other: add it"
    assert (code, logged) == (1, f"Pod foreign: {why}\n")
    code, _, logged = injected(control_plane, namespace, given=yaml.safe_dump(pod()))
    assert (code, "has no valid Detector 'town': create or correct it" in logged) == (1, True)
