"""A Detector of mode Sidecar, the pods that it is injected into, and their state at the API server."""

from __future__ import annotations

from typing import Any

from application_manager.core.objects.sidecars import CONTAINER
from tests.cluster.api import Api, Object
from tests.cluster.chain import HOLDER
from tests.cluster.test_manager_detectors import detector
from tests.cluster.waiting import wait_until

IMAGE = "wayside:1"
RUNS = ("--detector-image", IMAGE)
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


def create_accounts(api: Api) -> None:
    for name in ("vehicle", "other"):
        api.create({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": {"name": name}})


def wait_injecting(api: Api) -> None:
    wait_until(
        lambda: sidecars(api.apply(pod("probe"), dry_run=True)),
        lambda found: len(found) == 1,
        what="pods are reviewed",
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
