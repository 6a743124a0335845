"""EventRules and Detectors are told whether they can be evaluated, and what is wrong where."""

from __future__ import annotations

from typing import Any

from application_manager.core.rulestatus import detector_status, rule_status
from tests.unit.manager_objects import NOW
from wayside.api import Detector, EventRule


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
    streams = [{"name": stream, "key": "v/${client:*}/pose", "encoding": "json", **more}]
    return Detector.model_validate(
        {
            "kind": "Detector",
            "metadata": {"name": name, "namespace": "site"},
            "spec": {"streams": streams, "rules": {"matchLabels": {"site": site}}},
        }
    )


def test_a_rule_that_a_detector_can_evaluate_is_accepted() -> None:
    status = rule_status(rule(), [detector(), detector("other", site="b")], NOW)
    assert status.detectors == ["det"]
    assert (status.conditions[0].status, status.conditions[0].observed_generation) == ("True", 3)


def test_what_is_wrong_with_a_rule_is_told_with_its_place() -> None:
    status = rule_status(rule(when="sped > 3"), [detector()], NOW)
    (condition,) = status.conditions
    assert (condition.status, condition.reason) == ("False", "RuleInvalid")
    for part in ("spec.when", "column 1", "sped", "speed"):
        assert part in condition.message


def test_a_problem_with_one_detector_names_it() -> None:
    (condition,) = rule_status(rule(), [detector(), detector("blind", stream="odometry")], NOW).conditions
    assert condition.status == "False"
    assert condition.message.startswith("with Detector blind: spec.signals[0].stream")


def test_a_rule_that_nobody_selects_is_told_which_labels_would_help() -> None:
    (condition,) = rule_status(rule(), [detector(site="b")], NOW).conditions
    assert (condition.status, condition.reason) == ("False", "NotSelected")
    assert "det selects site=b" in condition.message


def test_a_detector_counts_its_rules_and_is_told_what_is_wrong_with_its_streams() -> None:
    assert detector_status(detector(), [rule()], NOW).rules == 1
    (condition,) = detector_status(detector(stamp="msg.t +"), [rule()], NOW).conditions
    assert (condition.status, condition.reason) == ("False", "DetectorInvalid")
    assert "spec.streams[0].stamp" in condition.message


def test_the_same_state_gives_the_same_status() -> None:
    first = rule_status(rule(), [detector()], NOW)
    again = rule_status(rule().model_copy(update={"status": first}), [detector()], NOW + 60)
    assert again == first
