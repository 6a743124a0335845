"""Ready means that the workload is ready according to its controller; other kinds by their conditions."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.core.health.readiness import not_ready


def judged(kind: str, status: dict[str, Any] | None = None, generation: int = 0, **spec: Any) -> str | None:
    return not_ready({"kind": kind, "metadata": {"generation": generation}, "spec": spec, "status": status or {}})


def condition(type_: str, status: str, **more: str) -> dict[str, Any]:
    return {"conditions": [{"type": type_, "status": status, **more}]}


FULL = {"availableReplicas": 2, "updatedReplicas": 2, "replicas": 2}


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        ({}, "has 0 of 2 pods available"),
        (FULL, None),
        (FULL | {"updatedReplicas": 1}, "has 1 of 2 pods of its current version"),
        (FULL | {"replicas": 3}, "still runs 1 pod of its previous version"),
        (
            condition("ReplicaFailure", "True", message="exceeded quota: small"),
            "has 0 of 2 pods available, and pods cannot be created: exceeded quota: small",
        ),
        (condition("Progressing", "False"), "has 0 of 2 pods available, and makes no progress"),
        (FULL | condition("Progressing", "False"), None),
    ],
)
def test_a_deployment_is_judged_by_its_rollout(status: dict[str, Any], expected: str | None) -> None:
    assert judged("Deployment", status, replicas=2) == expected


def test_a_status_of_an_older_generation_is_not_used() -> None:
    assert judged("Deployment", FULL, generation=2, replicas=2) == "has not been processed by its controller yet"
    assert judged("Deployment", FULL | {"observedGeneration": 2}, generation=2, replicas=2) is None


def test_a_workload_that_is_stopped_is_ready() -> None:
    assert judged("Deployment", replicas=0) is None
    assert judged("StatefulSet", replicas=0) is None


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ({}, "has 0 of 1 pods of its current version"),
        ({"updateStrategy": {"type": "OnDelete"}}, None),
        ({"updateStrategy": {"rollingUpdate": {"partition": 1}}}, None),
    ],
)
def test_a_stateful_set_is_judged_by_its_rollout(spec: dict[str, Any], expected: str | None) -> None:
    status = {"availableReplicas": 1, "currentRevision": "a", "updateRevision": "b", "updatedReplicas": 0}
    assert judged("StatefulSet", status, **spec) == expected
    assert judged("StatefulSet", status | {"updateRevision": "a"}, **spec) is None


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        ({}, "is not scheduled yet"),
        ({"desiredNumberScheduled": 3, "numberAvailable": 1}, "has 1 of 3 pods available"),
        ({"desiredNumberScheduled": 1, "numberAvailable": 1}, "has 0 of 1 pods of its current version"),
        ({"desiredNumberScheduled": 1, "numberAvailable": 1, "updatedNumberScheduled": 1}, None),
    ],
)
def test_a_daemon_set_is_judged_by_its_rollout(status: dict[str, Any], expected: str | None) -> None:
    assert judged("DaemonSet", status) == expected


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        ({}, "has no running pod"),
        ({"ready": 1}, None),
        ({"succeeded": 1}, None),
        (condition("Complete", "True"), None),
        (condition("Failed", "True", message="too many retries"), "has failed: too many retries"),
    ],
)
def test_a_job_is_judged_by_its_completion(status: dict[str, Any], expected: str | None) -> None:
    assert judged("Job", status) == expected
    assert judged("Job", suspend=True) == "is suspended (spec.suspend)"


def test_pods_claims_and_services_are_judged_by_their_status() -> None:
    assert judged("Pod", {"phase": "Pending"}) == "is not ready"
    assert judged("Pod", condition("Ready", "True")) is judged("Pod", {"phase": "Succeeded"}) is None
    assert judged("PersistentVolumeClaim", {"phase": "Pending"}) == "is not bound to a volume yet"
    assert judged("PersistentVolumeClaim", {"phase": "Lost"}) == "has lost its volume"
    assert judged("PersistentVolumeClaim", {"phase": "Bound"}) is None
    assert judged("Service", type="ClusterIP") is None
    assert judged("Service", type="LoadBalancer") == "has no load balancer address yet"
    assert judged("Service", {"loadBalancer": {"ingress": [{"ip": "10.0.0.1"}]}}, type="LoadBalancer") is None


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        ({}, None),
        ({"conditions": "of another shape"}, None),
        (condition("Ready", "True"), None),
        (condition("Available", "True"), None),
        (condition("Synced", "False"), None),
        (condition("Ready", "False", reason="Broken"), "is not ready: Broken"),
        (condition("Available", "Unknown", message="no answer"), "is not available: no answer"),
        (condition("Ready", "True") | {"observedGeneration": 1}, "has not been processed by its controller yet"),
    ],
)
def test_any_other_kind_goes_by_its_condition_ready_or_available(status: dict[str, Any], expected: str | None) -> None:
    assert judged("Broker", status, generation=2) == expected


def test_kinds_without_conditions_are_ready_by_being_there() -> None:
    assert not_ready({"kind": "ConfigMap", "metadata": {}}) is None
