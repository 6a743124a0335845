"""The reason why a pod does not run is reported in a message that stays constant while a kubelet retries."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.cache.pod_index import PodIndex
from application_manager.core.health.pods import Trouble, TroubleReason, summary, trouble
from application_manager.core.objects.ownership import INSTANCE_LABEL
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer
from tests.unit.manager_objects import DEPLOYMENT, instance, template

CAUSE = 'failed to resolve reference "app:1": app:1: not found'


def pod(name: str = "app-1", **status: Any) -> dict[str, Any]:
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {"name": name, "namespace": "site", "labels": {INSTANCE_LABEL: "app"}},
        "spec": {
            "initContainers": [{"name": "first", "image": "setup:2"}],
            "containers": [{"name": "main", "image": "app:1"}],
        },
        "status": {"phase": "Pending", **status},
    }


def container(state: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {
        "containerStatuses": [{"name": "main", "image": "", "ready": False, "restartCount": 0, "state": state, **more}]
    }


def waiting(reason: str, message: str = "") -> dict[str, Any]:
    return container({"waiting": {"reason": reason, "message": message}})


def logged(status: dict[str, Any]) -> tuple[str, str] | None:
    found = trouble(pod(**status))
    return (found.reason.value, found.message) if found else None


@pytest.mark.parametrize(
    "status",
    [
        waiting("ErrImagePull", f"rpc error: code = NotFound desc = {CAUSE}"),
        waiting(
            "ImagePullBackOff",
            f'Back-off pulling image "app:1": ErrImagePull: rpc error: code = NotFound desc = {CAUSE}',
        ),
    ],
)
def test_an_image_pull_failure_has_the_same_message_at_each_attempt(status: dict[str, Any]) -> None:
    assert logged(status) == ("ImagePullFailed", f"cannot pull image app:1: {CAUSE}")


def test_an_image_without_a_known_cause_is_reported_with_the_kubelets_reason() -> None:
    back_off = waiting("ImagePullBackOff", 'Back-off pulling image "app:1"')
    assert logged(back_off) == ("ImagePullFailed", "cannot pull image app:1: ImagePullBackOff")


def test_an_init_containers_image_is_named_too() -> None:
    init = [{"name": "first", "state": {"waiting": {"reason": "InvalidImageName", "message": "no name"}}}]
    assert logged({"initContainerStatuses": init}) == ("ImagePullFailed", "cannot pull image setup:2: no name")


ENDED = {"exitCode": 3, "reason": "Error", "finishedAt": "2026-01-01T00:00:00Z"}


@pytest.mark.parametrize(
    "status",
    [
        container({"terminated": ENDED}),
        container({"waiting": {"reason": "CrashLoopBackOff"}}, lastState={"terminated": ENDED}, restartCount=3),
        container({"running": {}}, lastState={"terminated": ENDED}, restartCount=4),
    ],
)
def test_a_crashing_container_has_the_same_message_between_and_during_its_restarts(status: dict[str, Any]) -> None:
    found = trouble(pod(**status))
    assert found is not None
    assert (found.reason, found.message) == (
        TroubleReason.CRASH_LOOP,
        "container main crashes: it ended with exit code 3",
    )
    assert found.hint == "its log: kubectl logs -n site app-1 -c main --previous"


def test_a_recovered_container_is_not_reported() -> None:
    assert logged(container({"running": {}}, lastState={"terminated": ENDED}, ready=True)) is None


def test_out_of_memory_and_termination_messages_are_reported() -> None:
    killed = container({"terminated": {"exitCode": 137, "reason": "OOMKilled"}})
    assert "exit code 137, killed for exceeding its memory limit" in str(logged(killed))
    speaks = container({"terminated": {**ENDED, "message": "no\nmap"}})
    assert str(logged(speaks)).endswith("exit code 3: no map')")


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (
            waiting("CreateContainerConfigError", 'secret "key" not found'),
            ("ContainerFailed", 'cannot start container main: secret "key" not found'),
        ),
        (
            {"conditions": [{"type": "PodScheduled", "status": "False", "message": "0/3 nodes are available"}]},
            ("Unschedulable", "no node fits the pod: 0/3 nodes are available"),
        ),
        (
            {"phase": "Failed", "reason": "Evicted", "message": "The node was low on memory."},
            ("PodFailed", "a pod failed: The node was low on memory."),
        ),
        (waiting("ContainerCreating"), None),
        ({}, None),
        ({"phase": "Succeeded", **container({"terminated": {"exitCode": 0}})}, None),
    ],
)
def test_other_pod_troubles_are_reported_and_healthy_pods_are_not(
    status: dict[str, Any], expected: tuple[str, str] | None
) -> None:
    assert logged(status) == expected


def test_a_container_that_is_not_restarted_counts_as_failed_not_crashing() -> None:
    once = pod(phase="Failed", **container({"terminated": ENDED}))
    once["spec"]["restartPolicy"] = "Never"
    found = trouble(once)
    assert found is not None
    assert (found.reason, found.message) == (
        TroubleReason.POD_FAILED,
        "container main failed: it ended with exit code 3",
    )


def test_a_terminating_pod_is_not_reported() -> None:
    going = pod(**waiting("ErrImagePull"))
    going["metadata"]["deletionTimestamp"] = "2026-01-01T00:00:00Z"
    assert trouble(going) is None


def test_the_same_trouble_of_many_pods_is_reported_once_and_the_most_specific_first() -> None:
    unschedulable = Trouble(TroubleReason.UNSCHEDULABLE, "no node")
    crashes = [Trouble(TroubleReason.CRASH_LOOP, "it crashes", f"log of {name}") for name in ("b", "a")]
    assert summary([unschedulable, *crashes]) == [crashes[1], unschedulable]


def test_the_index_knows_an_instances_troubles_and_whether_events_change_them() -> None:
    index, of = PodIndex(), ("site", "app")
    assert not index.note(pod())
    assert index.note(pod(**waiting("ErrImagePull", "no")))
    assert not index.note(pod("app-2", **waiting("ErrImagePull", "no")))
    assert [each.message for each in index.troubles(of)] == ["cannot pull image app:1: no"]
    assert not index.forget(pod("app-2"))
    assert index.note(pod())
    assert index.troubles(of) == []


def test_pods_of_every_workload_have_the_label_by_which_they_are_found() -> None:
    pods = DEPLOYMENT["spec"]["template"]
    job = {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {"name": "j"},
        "spec": {"template": {"spec": pods["spec"]}},
    }
    cron = {
        **job,
        "kind": "CronJob",
        "metadata": {"name": "c"},
        "spec": {"schedule": "@daily", "jobTemplate": {"spec": job["spec"]}},
    }
    wrong = {**job, "metadata": {"name": "w"}, "spec": {"template": {"metadata": {"labels": "none"}, "spec": {}}}}
    rendered = Renderer(template(manifests=[DEPLOYMENT, job, cron, wrong]), Policy()).render(instance()).manifests
    deployed, ran, scheduled, as_written = (each["spec"] for each in rendered)
    assert deployed["template"]["metadata"]["labels"] == {"app": "app", INSTANCE_LABEL: "app"}
    assert ran["template"]["metadata"]["labels"] == {INSTANCE_LABEL: "app"}
    assert scheduled["jobTemplate"]["spec"]["template"]["metadata"]["labels"] == {INSTANCE_LABEL: "app"}
    assert as_written["template"]["metadata"]["labels"] == "none"
