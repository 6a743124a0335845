"""Suspension: objects scaled to zero, paused objects, and the instance's condition."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from application_manager.core.claims.operations import Verdict, VerdictKind
from application_manager.core.demand.demand import demand
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer
from application_manager.core.statuses.status import (
    InstanceProgress,
    combined_progress,
    suspended_condition,
    task_status,
)
from tests.unit.manager_objects import DEPLOYMENT, NOW, instance, task, template
from wayside.api import ApplicationInstance

POD = DEPLOYMENT["spec"]["template"]
COUNTS = Verdict(VerdictKind.COUNTS, "Accepted", "counts", "app")


def named(kind: str, api_version: str, spec: dict[str, Any], name: str = "${instance.name}") -> dict[str, Any]:
    return {"apiVersion": api_version, "kind": kind, "metadata": {"name": name}, "spec": spec}


def autoscaler(target: str = "${instance.name}", kind: str = "Deployment") -> dict[str, Any]:
    scaled = {"apiVersion": "apps/v1", "kind": kind, "name": target}
    return named("HorizontalPodAutoscaler", "autoscaling/v2", {"scaleTargetRef": scaled, "maxReplicas": 5})


def rendered(*manifests: dict[str, Any], suspended: bool = False) -> Any:
    return Renderer(template(manifests=list(manifests)), Policy()).render(instance(suspended=suspended))


EVERYTHING = (
    DEPLOYMENT,
    named("StatefulSet", "apps/v1", {"selector": {}, "template": POD}),
    named("DaemonSet", "apps/v1", {"selector": {}, "template": POD}),
    named("Job", "batch/v1", {"template": POD}),
    named("CronJob", "batch/v1", {"schedule": "* * * * *", "jobTemplate": {"spec": {"template": POD}}}),
    named("Pod", "v1", POD["spec"]),
    named("Service", "v1", {"ports": [{"port": 80}]}),
    autoscaler("other"),
)


def test_every_kind_is_suspended_by_its_own_field_only() -> None:
    running, stopped = rendered(*EVERYTHING), rendered(*EVERYTHING, suspended=True)
    before = {each["kind"]: each for each in running.manifests}
    after = {each["kind"]: each for each in stopped.manifests}
    assert before.keys() - after.keys() == {"DaemonSet", "Pod"}
    for kind, change in {
        "Deployment": {"replicas": 0},
        "StatefulSet": {"replicas": 0},
        "Job": {"suspend": True},
        "CronJob": {"suspend": True},
        "Service": {},
        "HorizontalPodAutoscaler": {},
    }.items():
        assert after[kind] == {**before[kind], "spec": {**before[kind]["spec"], **change}}
    assert (
        stopped.replicas
        == running.replicas
        == {("apps/v1", "Deployment", "app"): 1, ("apps/v1", "StatefulSet", "app"): None}
    )
    assert stopped.digest != running.digest
    assert rendered(*EVERYTHING).digest == running.digest


@pytest.mark.parametrize(
    ("target", "states"),
    [(autoscaler(), False), (autoscaler("other"), True), (autoscaler(kind="StatefulSet"), True)],
)
def test_replicas_are_left_to_an_autoscaler_of_the_same_template(target: Any, states: bool) -> None:
    manifest = copy.deepcopy(DEPLOYMENT)
    deployment, _ = rendered(manifest, target).manifests
    assert ("replicas" in deployment["spec"]) is states
    assert rendered(manifest, target).replicas == {("apps/v1", "Deployment", "app"): 1 if states else None}
    assert manifest == DEPLOYMENT


def logged(stopped: ApplicationInstance, *objects: Any) -> tuple[str, str, str] | None:
    (decision,) = demand(
        [template()], [task("a"), task("night", operation="Suspend")], [stopped], {}, NOW
    ).instances.values()
    state = suspended_condition(stopped, decision, objects)
    return None if state is None else (state.status, state.reason, state.message)


def live(replicas: int, pods: int) -> dict[str, Any]:
    return {**DEPLOYMENT, "metadata": {"name": "app"}, "spec": {"replicas": replicas}, "status": {"replicas": pods}}


def test_the_instance_reports_its_suspending_task_remaining_pods_and_paused_objects() -> None:
    stopped = instance(suspended=True)
    assert logged(instance(), live(1, 1)) is None
    assert logged(stopped, live(0, 2)) == (
        "False", "Stopping", "task night suspends it: Deployment app has 2 pods left",
    )  # fmt: skip
    scaler = {**autoscaler(), "metadata": {"name": "scaler"}}
    assert logged(stopped, live(0, 0), scaler, None) == (
        "True",
        "Suspended",
        "task night suspends it; its workloads are scaled to zero; "
        "HorizontalPodAutoscaler scaler is inactive until it resumes",
    )


def test_phases_of_tasks_describe_the_suspension() -> None:
    on, off = (
        InstanceProgress("app", True, False, suspended=True),
        InstanceProgress("app", True, False, suspended=True, stopped=True),
    )
    night = task("night", operation="Suspend")
    assert task_status(task("a"), COUNTS, off, NOW, 0).phase == "Suspended"
    assert [task_status(night, COUNTS, each, NOW, 0).phase for each in (on, off)] == ["Active", "Ready"]
    waiting = task_status(night, Verdict(VerdictKind.WAITING, "NothingRuns", "starts nothing"), None, NOW, 0)
    assert (waiting.phase, waiting.conditions[0].status, waiting.conditions[0].reason) == (
        "Waiting",
        "True",
        "NothingRuns",
    )
    both = combined_progress([off, InstanceProgress("b", True, True)])
    assert (both.instance, both.applied, both.ready, both.suspended, both.stopped) == (
        "app, b",
        True,
        False,
        True,
        False,
    )
