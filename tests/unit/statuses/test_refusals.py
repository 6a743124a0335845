"""Rejections by the cluster's own rules are reported by kind, in constant words, and retried with backoff."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.core.health.refusals import has_too_few_pods, reason_of, refused_by_events, refused_pods
from application_manager.work.instances import FIRST_PAUSE, LONGEST_PAUSE, Attempts
from wayside.times import format_time

QUOTA = 'pods "app-6b4-zk5mt" is forbidden: exceeded quota: few, requested: pods=1, used: pods=0, limited: pods=0'


@pytest.mark.parametrize(
    ("code", "message", "reason"),
    [
        (403, QUOTA, "QuotaExceeded"),
        (403, 'pods "x" is forbidden: maximum cpu usage per Container is 1, but limit is 2', "AdmissionRefused"),
        (400, 'admission webhook "w" denied the request: no', "AdmissionRefused"),
        (422, "x: ValidatingAdmissionPolicy 'p' with binding 'b' denied request: no", "AdmissionRefused"),
        (403, 'deployments.apps "x" is forbidden: User "m" cannot patch resource "deployments"', "ApplyRefused"),
        (422, 'Deployment.apps "x" is invalid: spec.replicas: Invalid value: -1', "ApplyRefused"),
    ],
)
def test_each_refusal_has_its_reason(code: int, message: str, reason: str) -> None:
    assert reason_of(code, message) == reason


def test_rejected_pods_of_a_deployment_have_a_constant_message() -> None:
    def reported(message: str, kind: str = "Deployment", status: str = "True") -> str | None:
        conditions = [{"type": "ReplicaFailure", "status": status, "message": message}]
        found = refused_pods({"kind": kind, "metadata": {"name": "app"}, "status": {"conditions": conditions}})
        return found.text if found else None

    text = reported(QUOTA)
    assert text is not None
    assert text.startswith("pods are refused: forbidden: exceeded quota: few")
    assert "raise the ResourceQuota" in text
    assert reported(QUOTA.replace("zk5mt", "other")) == text
    assert reported(QUOTA, status="False") is None
    assert reported(QUOTA, kind="ReplicaSet") == text
    assert reported(QUOTA, kind="StatefulSet") is None


@pytest.mark.parametrize(
    ("kind", "spec", "status", "lacks"),
    [
        ("StatefulSet", {"replicas": 2}, {"replicas": 1}, True),
        ("StatefulSet", {}, {}, True),
        ("StatefulSet", {"replicas": 2}, {"replicas": 2}, False),
        ("StatefulSet", {"replicas": 0}, {}, False),
        ("DaemonSet", {}, {"desiredNumberScheduled": 2, "currentNumberScheduled": 1}, True),
        ("DaemonSet", {}, {"desiredNumberScheduled": 2, "currentNumberScheduled": 2}, False),
        ("DaemonSet", {}, {}, False),
        ("Job", {}, {}, True),
        ("Job", {}, {"active": 1}, False),
        ("Job", {}, {"failed": 1}, False),
        ("Job", {"suspend": True}, {}, False),
        ("Deployment", {"replicas": 1}, {}, False),
    ],
)
def test_missing_pods_are_reported_from_the_workloads_status(kind: str, spec: Any, status: Any, lacks: bool) -> None:
    assert has_too_few_pods({"kind": kind, "metadata": {"name": "app"}, "spec": spec, "status": status}) is lacks


NOW = 1_792_000_000.0  # seconds since 1970


def event(note: str, ago: float, **more: Any) -> dict[str, Any]:
    return {"reason": "FailedCreate", "note": note, "eventTime": format_time(round((NOW - ago) * 1e9)), **more}


def test_the_last_event_gives_a_constant_message_for_rejected_pods() -> None:
    older = event("Error creating: " + QUOTA.replace("few", "another"), 30)
    newer = event(f"create Pod app-0 in StatefulSet app failed error: {QUOTA}", 3)
    found = refused_by_events([newer, older], NOW)
    assert found is not None
    assert found.reason.value == "QuotaExceeded"
    assert found.text.startswith("pods are refused: forbidden: exceeded quota: few")
    assert refused_by_events([older, event("Error creating: " + QUOTA, 1)], NOW) == found


def test_an_event_that_is_repeated_is_as_old_as_its_last_time() -> None:
    last = format_time(round((NOW - 2) * 1e9))
    repeated = {"eventTime": None, "deprecatedLastTimestamp": last}
    assert refused_by_events([event(QUOTA, 0) | repeated], NOW) is not None
    assert refused_by_events([event(QUOTA, 9000, series={"count": 9, "lastObservedTime": last})], NOW) is not None


def test_old_events_and_other_reasons_are_ignored() -> None:
    assert refused_by_events([], NOW) is None
    assert refused_by_events([event(QUOTA, 3600)], NOW) is None
    assert refused_by_events([event(QUOTA, 1) | {"reason": "BackOff"}], NOW) is None


def test_a_rejection_for_a_controllers_missing_right_counts_as_admission() -> None:
    found = refused_by_events([event('pods is forbidden: User "c" cannot create resource "pods"', 1)], NOW)
    assert found is not None
    assert found.reason.value == "AdmissionRefused"


def test_the_same_rejection_is_retried_with_backoff_and_a_changed_object_at_once() -> None:
    attempts, now = Attempts(), 1000.0
    assert attempts.waits_until(("site", "a"), "x", now) is None
    pauses = []
    for _ in range(12):
        until = attempts.note_refusal(("site", "a"), "x", now)
        assert attempts.waits_until(("site", "a"), "x", now) == until
        assert attempts.waits_until(("site", "a"), "y", now) is None
        assert attempts.waits_until(("site", "b"), "x", now) is None
        pauses.append(until - now)
        now = until
        assert attempts.waits_until(("site", "a"), "x", now) is None
    assert 0 < pauses[0] <= FIRST_PAUSE < pauses[2]
    assert LONGEST_PAUSE / 2 < pauses[-1] <= LONGEST_PAUSE
    assert attempts.note_refusal(("site", "a"), "y", now) - now <= FIRST_PAUSE
    attempts.forget(("site", "a"))
    assert attempts.waits_until(("site", "a"), "y", now) is None
