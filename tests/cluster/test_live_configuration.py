"""A configuration that changes reaches pods and Zenoh at once, and restarts nothing."""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
import zenoh

from application_manager.core.objects.configuration import ANNOTATION, fingerprint
from tests.cluster.api import Api, Object
from tests.cluster.children import GRACE
from tests.cluster.expected_objects import end, start_manager, task, wait_settled
from tests.cluster.processes import Process, Processes
from tests.cluster.repeating import repeated
from tests.cluster.waiting import wait_until
from tests.networks import router
from tests.patience import PATIENCE
from tests.ports import free_endpoint

EXAMPLE = Path(__file__).parents[2] / "examples" / "live-configuration"
CONFIG_MAP = "fusion-configuration"


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def network(endpoint: str) -> Iterator[zenoh.Session]:
    with router(listen__endpoints=[endpoint]) as session:
        yield session


@pytest.fixture
def manager(processes: Processes, namespace: str, endpoint: str) -> Process:
    return start_manager(processes, namespace, "--zenoh", endpoint)


def template() -> Any:
    raw = yaml.safe_load((EXAMPLE / "templates.yaml").read_text())
    raw["spec"]["lifecycle"] = {"linger": "0s"}
    return raw


def vehicle(name: str) -> Object:
    return {**task(name, of="fusion"), "spec": {"templateName": "fusion", "parameters": {"sources": [name]}}}


def sources_in(content: str) -> list[str]:
    sources: list[str] = yaml.safe_load(content)["sources"]
    return sources


def wait_for_sources(api: Api, *expected: str) -> None:
    api.wait_for(
        "ConfigMap",
        CONFIG_MAP,
        lambda raw: sources_in(raw["data"]["sources.yaml"]) == [*expected],
        what=f"the sources are {expected}",
    )


def wait_for_pod(api: Api) -> Object:
    (pod,) = api.wait_list("Pod", lambda pods: len(pods) == 1, what="there is one pod")
    return pod


def wait_until_announced(api: Api, *sources: str) -> Object:
    """Wait until the pod's annotation matches the configuration with these sources; return the pod."""
    wait_for_sources(api, *sources)
    content = fingerprint(api.get("ConfigMap", CONFIG_MAP)["data"])
    (pod,) = api.wait_list(
        "Pod",
        lambda pods: [each["metadata"].get("annotations", {}).get(ANNOTATION) for each in pods] == [content],
        what=f"the only pod receives {sources}",
    )
    return pod


class SourcesSubscriber:
    """Collects the sources published on a key; None for a deletion."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.contents: list[list[str] | None] = []
        self._changed = threading.Condition()
        self._subscriber = session.declare_subscriber(key, self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        deleted = sample.kind == zenoh.SampleKind.DELETE
        with self._changed:
            self.contents.append(None if deleted else _sources_of(sample))
            self._changed.notify_all()

    def wait_for(self, expected: list[str] | None) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: self.contents[-1:] == [expected], PATIENCE), self.contents


def _sources_of(sample: zenoh.Sample) -> list[str]:
    return sources_in(json.loads(sample.payload.to_bytes())["sources.yaml"])


def requested(session: zenoh.Session, key: str) -> list[list[str]]:
    """The answer to a late joiner's query on the key."""
    return [_sources_of(reply.ok) for reply in session.get(key) if reply.ok is not None]


def test_a_configuration_change_annotates_the_pods_and_leaves_their_template_alone(api: Api, manager: Process) -> None:
    api.create(template())
    api.create(vehicle("car1"))
    pod = wait_for_pod(api)
    deployment = api.get("Deployment", "fusion")
    api.create(vehicle("car2"))
    reported = wait_until_announced(api, "car1", "car2")
    assert reported["metadata"]["uid"] == pod["metadata"]["uid"]
    now = api.get("Deployment", "fusion")
    assert now["spec"] == deployment["spec"]
    assert now["metadata"]["generation"] == deployment["metadata"]["generation"]
    wait_settled(api)
    end(api, "car2")
    wait_until_announced(api, "car1")
    wait_settled(api)


def test_foreign_pods_with_the_same_labels_are_left_alone(api: Api, manager: Process) -> None:
    """A pod that has the same labels as the instance's pod but does not mount its configuration."""
    api.create(template())
    api.create(
        {
            "apiVersion": "v1",
            "kind": "Pod",
            "metadata": {"name": "stranger", "labels": {"app": "fusion"}},
            "spec": {"containers": [{"name": "main", "image": "other:1"}]},
        }
    )
    api.create(vehicle("car1"))
    api.wait_list("Pod", lambda pods: len(pods) == 2, what="the application has its pod")
    api.create(vehicle("car2"))
    api.wait_list(
        "Pod",
        lambda pods: [_was_announced(each) for each in pods if each["metadata"]["name"] != "stranger"] == [True],
        what="the application's pod is annotated",
    )
    assert not _was_announced(api.get("Pod", "stranger"))


def _was_announced(pod: Object) -> bool:
    return ANNOTATION in pod["metadata"].get("annotations", {})


def test_zenoh_publishes_each_change_and_answers_late_joiners(
    api: Api, namespace: str, network: zenoh.Session, manager: Process
) -> None:
    key = f"wayside/instances/{namespace}/fusion/configuration"
    reported = SourcesSubscriber(network, key)
    api.create(template())
    api.create(vehicle("car1"))
    reported.wait_for(["car1"])
    api.create(vehicle("car2"))
    reported.wait_for(["car1", "car2"])
    assert requested(network, key) == [["car1", "car2"]]
    assert requested(network, "wayside/instances/*/fusion/**") == [["car1", "car2"]]
    assert requested(network, f"wayside/instances/{namespace}/other/configuration") == []
    for each in ("car1", "car2"):
        end(api, each)
    reported.wait_for(None)
    assert requested(network, key) == []


def test_a_restarted_manager_answers_queries_again(
    api: Api, namespace: str, network: zenoh.Session, manager: Process
) -> None:
    key = f"wayside/instances/{namespace}/fusion/configuration"
    api.create(template())
    api.create(vehicle("car1"))
    wait_until(lambda: requested(network, key), lambda found: found == [["car1"]], what="the query has an answer")
    manager.kill9()
    api.create(vehicle("car2"))
    manager.restart()
    wait_until(
        lambda: requested(network, key), lambda found: found == [["car1", "car2"]], what="the query has an answer again"
    )
    wait_until_announced(api, "car1", "car2")


def test_the_zenoh_router_may_start_late_and_stop(api: Api, namespace: str, endpoint: str, manager: Process) -> None:
    key = f"wayside/instances/{namespace}/fusion/configuration"
    api.create(template())
    api.create(vehicle("car1"))
    wait_for_sources(api, "car1")
    wait_settled(api)  # everything else continues without a network
    for number in (2, 3):
        with router(listen__endpoints=[endpoint]) as session:
            cars = [f"car{each}" for each in range(1, number)]
            wait_until(
                lambda: requested(session, key),
                lambda found, cars=cars: found == [cars],
                what="the query has an answer",
            )
            reported = SourcesSubscriber(session, key)
            api.create(vehicle(f"car{number}"))
            reported.wait_for([*cars, f"car{number}"])
    assert manager.terminate(patience=GRACE) == 0


class Mount:
    """A mounted ConfigMap, updated as by a kubelet when the pod's annotation changes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._seen: str | None = None
        self._versions = 0

    def sync(self, api: Api) -> None:
        """Update the files as the kubelet does if the pod has changed since."""
        pod = wait_for_pod(api)
        annotation = pod["metadata"].get("annotations", {}).get(ANNOTATION, "")
        if annotation == self._seen:
            return
        self._seen = annotation
        self._versions += 1
        version = self.folder / f"..{self._versions}"
        version.mkdir()
        for name, text in api.get("ConfigMap", CONFIG_MAP)["data"].items():
            (version / name).write_text(text)
            if not (self.folder / name).is_symlink():
                (self.folder / name).symlink_to(f"..data/{name}")
        (self.folder / "..new").symlink_to(version.name)
        os.replace(self.folder / "..new", self.folder / "..data")

    def wait_for(self, api: Api, *sources: str) -> None:
        def look() -> list[str]:
            self.sync(api)
            return sources_in((self.folder / "sources.yaml").read_text())

        wait_until(look, lambda found: found == [*sources], what=f"the kubelet syncs the files with {sources}")


@pytest.mark.parametrize("way", ["zenoh", "file"])
def test_the_example_follows_its_sources(
    api: Api, namespace: str, endpoint: str, network: zenoh.Session, processes: Processes, tmp_path: Path, way: str
) -> None:
    start_manager(processes, namespace, *(["--zenoh", endpoint] if way == "zenoh" else []))
    api.create(template())
    api.create(vehicle("car1"))
    wait_for_sources(api, "car1")
    (folder := tmp_path / "mount").mkdir()
    mount = Mount(folder)
    mount.sync(api)
    where = ["--file", str(folder / "sources.yaml"), "--zenoh", endpoint, "--instance", f"{namespace}/fusion"]
    application = processes.start(sys.executable, str(EXAMPLE / "follow.py"), *where, name="application")
    application.wait_for_output("following car1 ")
    api.create(vehicle("car2"))
    if way == "file":
        mount.wait_for(api, "car1", "car2")
    application.wait_for_output(f"following car1, car2 .by {way}.")
    # Its subscription reaches this session after a moment.
    with repeated("vehicle", lambda: network.put("vehicles/car2/pose", "here"), 0.1):
        application.wait_for_output("vehicles/car2/pose: here")
    end(api, "car1")
    if way == "file":
        mount.wait_for(api, "car2")
    application.wait_for_output(f"following car2 .by {way}.")
    assert application.starts == 1
    assert application.terminate() == 0
