"""The status of EventRules and Detectors reports whether they can be evaluated, and errors with their place."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from kubernetes.aio.client import Configuration

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.core.findings.rulefindings import RuleContext
from application_manager.core.objects.policy import Policy
from application_manager.core.statuses.rulestatus import detector_status, rule_status
from application_manager.work.recorder import Recorder
from application_manager.work.statuses import StatusWriter
from application_manager.work.validating import RuleWork
from tests.inprocess import InProcess
from tests.unit.manager_objects import NOW
from wayside.api import API_VERSION, Detector, EventRule
from wayside.kubernetes.client import Client
from wayside.kubernetes.resources import Resource


def rule(**spec: Any) -> EventRule:
    return EventRule.model_validate(
        {
            "kind": "EventRule",
            "metadata": {"name": "fast", "namespace": "site", "labels": {"site": "a"}, "generation": 3},
            "spec": {
                "signals": [{"name": "speed", "stream": "pose", "value": "msg.speed"}],
                "when": "speed > 3",
                **spec,
            },
        }
    )


def detector(name: str = "det", stream: str = "pose", site: str = "a", **more: Any) -> Detector:
    streams = [{"name": stream, "key": "v/${client:*}/pose", "encoding": "json"} | more]
    return Detector.model_validate(
        {
            "kind": "Detector",
            "metadata": {"name": name, "namespace": "site"},
            "spec": {"streams": streams, "ruleSelector": {"matchLabels": {"site": site}}},
        }
    )


def test_a_rule_that_a_detector_can_evaluate_is_accepted() -> None:
    status = rule_status(rule(), RuleContext([detector(), detector("other", site="b")]), NOW)
    assert status.detectors == ["det"]
    assert status.selected_by == "det"
    many = rule_status(rule(), RuleContext([detector(f"d{number}") for number in range(7)]), NOW)
    assert many.selected_by == "d0, d1, d2, d3, d4, and 2 more"
    assert (status.conditions[0].status, status.conditions[0].observed_generation) == ("True", 3)


def test_errors_of_a_rule_are_reported_by_field() -> None:
    status = rule_status(rule(when="sped > 3"), RuleContext([detector()]), NOW)
    condition = status.conditions[0]
    assert (condition.status, condition.reason) == ("False", "RuleInvalid")
    for part in ("spec.when", "column 1", "sped", "speed"):
        assert part in condition.message


def test_ready_and_stalled_follow_the_errors_and_stalled_is_removed_with_them() -> None:
    wrong = rule_status(rule(when="sped > 3"), RuleContext([detector()]), NOW)
    assert [(each.type, each.status) for each in wrong.conditions] == [
        ("Accepted", "False"),
        ("Ready", "False"),
        ("Stalled", "True"),
    ]
    assert (
        rule_status(rule(when="sped > 3").model_copy(update={"status": wrong}), RuleContext([detector()]), NOW + 9)
        == wrong
    )
    right = rule_status(rule().model_copy(update={"status": wrong}), RuleContext([detector()]), NOW)
    assert [(each.type, each.status) for each in right.conditions] == [("Accepted", "True"), ("Ready", "True")]
    alone = rule_status(rule().model_copy(update={"status": wrong}), RuleContext(), NOW)
    assert [(each.type, each.reason) for each in alone.conditions] == [
        ("Accepted", "NotSelected"),
        ("Ready", "NotSelected"),
    ]


def test_a_problem_with_one_detector_names_it() -> None:
    condition = rule_status(rule(), RuleContext([detector(), detector("blind", stream="odometry")]), NOW).conditions[0]
    assert condition.status == "False"
    assert condition.message.startswith("with Detector blind: spec.signals[0].stream")


def test_an_unselected_rule_is_reported_with_the_selecting_labels() -> None:
    condition = rule_status(rule(), RuleContext([detector(site="b")]), NOW).conditions[0]
    assert (condition.status, condition.reason) == ("False", "NotSelected")
    assert "det selects site=b" in condition.message


def test_a_detector_counts_its_rules_and_reports_errors_of_its_streams() -> None:
    assert detector_status(detector(), [rule()], NOW).rules == 1
    condition = detector_status(detector(stamp="msg.t +"), [rule()], NOW).conditions[0]
    assert (condition.status, condition.reason) == ("False", "DetectorInvalid")
    assert "spec.streams[0].stamp" in condition.message


def test_an_invalid_key_is_reported_by_field() -> None:
    condition = detector_status(detector(key="v//${client:*}/pose"), [], NOW).conditions[0]
    assert (condition.status, condition.reason) == ("False", "DetectorInvalid")
    assert (
        "spec.streams[0].key: key 'v//${client:*}/pose', column 3: the pattern has two slashes in a row"
        in condition.message
    )


def test_an_accepted_rule_names_the_checks_left_to_the_detector() -> None:
    for status in (rule_status(rule(), RuleContext([detector()]), NOW), detector_status(detector(), [], NOW)):
        assert "message types are checked only by the detector" in status.conditions[0].message


def test_an_unselected_rule_is_reported_with_invalid_detectors() -> None:
    condition = rule_status(rule(), RuleContext([], ["det"]), NOW).conditions[0]
    assert (condition.status, condition.reason) == ("False", "NotSelected")
    assert "correct Detector det; its status gives the error" in condition.message


@pytest.mark.parametrize(("kind", "reason"), [("EventRule", "RuleInvalid"), ("Detector", "DetectorInvalid")])
def test_an_invalid_stored_object_is_reported_in_its_status(kind: str, reason: str) -> None:
    cache = ClusterCache(Policy())
    written: list[dict[str, Any]] = []

    def observe(seen: dict[str, Any]) -> None:
        cache.store.put(seen)

    raw: dict[str, Any] = {
        "apiVersion": API_VERSION,
        "kind": kind,
        "metadata": {"name": "odd", "namespace": "site", "uid": "u", "resourceVersion": "1", "generation": 2},
        "spec": {"odd": True},
    }
    assert cache.store.put(raw) is not None

    class AcceptingClient(Client):
        """An API server that takes every status."""

        async def patch_status(
            self, resource: Resource, namespace: str, name: str, uid: str, status: dict[str, Any]
        ) -> dict[str, Any]:
            written.append(status)
            return {**raw, "metadata": {**raw["metadata"], "resourceVersion": str(len(written) + 1)}, "status": status}

    async def reconcile_twice() -> None:
        client = AcceptingClient(Configuration(), "test", field_manager="test")
        work = RuleWork(cache, StatusWriter(client, Recorder(client), observe), InProcess())
        await work.reconcile(((API_VERSION, kind), ("site", "odd")))
        await work.reconcile(((API_VERSION, kind), ("site", "odd")))
        await client.close()

    asyncio.run(reconcile_twice())
    (status,) = written
    condition = status["conditions"][0]
    assert (condition["status"], condition["reason"], condition["observedGeneration"]) == ("False", reason, 2)
    assert "spec.odd: unknown field" in condition["message"]


def test_warnings_about_a_valid_rule_are_reported_and_it_stays_accepted() -> None:
    deploying = rule(actions=[{"name": "go", "deploy": {"templateName": "app"}}])
    condition = rule_status(deploying, RuleContext([detector()]), NOW).conditions[0]
    assert condition.status == "True"
    assert "; but spec.actions[0].deploy.templateName: there is no ApplicationTemplate app in" in condition.message


def test_the_same_state_gives_the_same_status() -> None:
    first = rule_status(rule(), RuleContext([detector()]), NOW)
    again = rule_status(rule().model_copy(update={"status": first}), RuleContext([detector()]), NOW + 60)
    assert again == first
