"""The status of EventRules and Detectors reports whether they can be evaluated."""

from __future__ import annotations

import copy

from tests.cluster.api import Api, Object
from tests.cluster.expected_objects import condition, config, start_manager, template
from tests.cluster.manifests import DETECTOR, EVENT_RULE
from tests.cluster.processes import Processes


def judged(raw: Object) -> str:
    return str(condition(raw, "Accepted").get("reason"))


def test_a_rules_status_follows_its_detectors_and_reports_errors(
    api: Api, processes: Processes, namespace: str
) -> None:
    start_manager(processes, namespace)
    rule, detector = copy.deepcopy(EVENT_RULE), copy.deepcopy(DETECTOR)
    rule["metadata"]["labels"] = {"site": "intersection-a"}
    detector["spec"]["streams"] += [
        {"name": name, "key": f"vehicles/${{client:*}}/{name}", "encoding": "json"} for name in ("points", "odometry")
    ]
    name = rule["metadata"]["name"]
    api.create(rule)
    api.wait_for("EventRule", name, lambda raw: judged(raw) == "NotSelected", what="nobody selects it")
    api.create(detector)
    accepted = api.wait_for("EventRule", name, lambda raw: judged(raw) == "Accepted", what="it is accepted")
    assert accepted["status"]["detectors"] == ["intersection-a"]
    assert "there is no ApplicationTemplate recorder" in condition(accepted, "Accepted")["message"]
    recorder = template("recorder", parameters={"vehicles": {"type": "array"}}, manifests=[config({})])
    del recorder["spec"]["key"]
    api.create(recorder)
    api.wait_for(
        "EventRule",
        name,
        lambda raw: "recorder" not in condition(raw, "Accepted")["message"],
        what="its template exists",
    )
    api.wait_for(
        "Detector",
        "intersection-a",
        lambda raw: raw.get("status", {}).get("rules") == 1 and judged(raw) == "Accepted",
        what="the detector counts it",
    )
    api.patch("EventRule", name, {"spec": {"when": "distence < 150"}})
    refused = api.wait_for("EventRule", name, lambda raw: judged(raw) == "RuleInvalid", what="it is refused")
    reported = condition(refused, "Accepted")
    assert reported["observedGeneration"] == refused["metadata"]["generation"]
    for part in ("spec.when", "line 1, column 1", "distence", "distance"):
        assert part in reported["message"]
    api.delete("EventRule", name)
    api.wait_for(
        "Detector",
        "intersection-a",
        lambda raw: raw.get("status", {}).get("rules") == 0,
        what="it is no longer counted",
    )
