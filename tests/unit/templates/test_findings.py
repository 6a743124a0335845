"""Errors in templates, rules and detectors are found before their use, and distinguished from valid
uses."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from application_manager.core.findings.findings import Findings
from application_manager.core.findings.rulefindings import deploy_remarks, detector_findings, rule_findings
from application_manager.core.findings.templatefindings import template_findings
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import MOST_EXPRESSIONS
from tests.unit.manager_objects import DEPLOYMENT, template
from wayside.api import Detector, EventRule
from wayside.findings import IGNORE_ANNOTATION

REGION = {"region": {"type": "string", "required": True}}


def rule(name: str = "fast", **spec: Any) -> EventRule:
    signals = [{"name": "speed", "stream": "pose", "value": "msg.speed"}]
    metadata = {"name": name, "namespace": "site", "labels": {"site": "a"}}
    return EventRule.model_validate(
        {"kind": "EventRule", "metadata": metadata, "spec": {"signals": signals, "when": "speed > 3", **spec}}
    )


def counting(name: str, of: str) -> EventRule:
    signal = {"name": "others", "ruleName": of, "over": "10s", "aggregate": "Count"}
    return rule(name, signals=[signal], when="others > 2")


def detector(name: str = "det", stream: str = "pose", site: str = "a", **more: Any) -> Detector:
    streams = [{"name": stream, "key": "v/${client:*}/pose", "encoding": "json"}]
    spec = {"streams": streams, "ruleSelector": {"matchLabels": {"site": site}}, **more}
    return Detector.model_validate({"kind": "Detector", "metadata": {"name": name, "namespace": "site"}, "spec": spec})


def container(**fields: Any) -> dict[str, Any]:
    made = copy.deepcopy(DEPLOYMENT)
    made["spec"]["template"]["spec"]["containers"][0] |= fields
    return made


def test_a_rule_that_a_detector_can_evaluate_has_no_findings() -> None:
    assert rule_findings(rule(), [detector()]) == Findings()


def test_errors_of_the_rule_alone_are_problems_without_a_detector_too() -> None:
    found = rule_findings(rule(when="sped > 3"), [])
    assert [part in found.problems[0] for part in ("spec.when", "column 1", "sped")] == [True] * 3
    assert "create a Detector" in str(found.doubts[0])
    assert not rule_findings(rule(), []).problems


@pytest.mark.parametrize(
    "spec",
    [
        {"actions": [{"name": "bag", "record": {"streams": ["points"], "before": "10m", "after": "5s"}}]},
        {"actions": [{"name": "db", "database": {}}]},
        {"scope": {"pairs": {"position": {"stream": "gps", "latitude": "msg.lat", "longitude": "msg.lon"},
                             "within": 100}}, "signals": [], "when": "closingSpeed > 1"},
        {"evaluation": {"onSample": "pose"}},
        {"signals": [{"name": "speed", "stream": "x", "value": "msg.v", "over": "2h", "aggregate": "Mean"}]},
    ],
    ids=["record", "database", "pairs", "on sample", "a long window"],
)  # fmt: skip
def test_requirements_on_a_detector_are_not_problems_of_the_rule_alone(spec: dict[str, Any]) -> None:
    assert not rule_findings(rule(**spec), []).problems


def test_a_stream_missing_in_all_selecting_detectors_is_a_problem_and_in_some_a_warning() -> None:
    blind = detector("blind", stream="odometry")
    assert "no stream pose" in rule_findings(rule(), [blind]).problems[0]
    found = rule_findings(rule(), [detector(), blind])
    assert not found.problems
    assert str(found.doubts[0]).startswith("with Detector blind: spec.signals[0].stream")


def test_a_missing_rule_is_a_warning_and_a_cycle_a_problem() -> None:
    missing = rule_findings(counting("many", "fast"), [detector()])
    assert not missing.problems
    assert "there is no rule fast" in str(missing.doubts[0])
    assert rule_findings(counting("many", "fast"), [detector()], (), [rule()]) == Findings()
    circle = rule_findings(counting("many", "fast"), [detector()], (), [counting("fast", "many")])
    assert "cycle" in circle.problems[0]
    assert "cycle" in rule_findings(counting("many", "many"), [detector()]).problems[0]


def test_errors_in_a_detectors_field_are_not_problems_of_the_rule() -> None:
    client = {"name": "car", "parameters": {"fast": {"limti": 3}}}
    found = rule_findings(rule(parameters={"limit": 2}), [detector(clients=[client])])
    assert not found.problems
    assert str(found.doubts[0]).startswith("Detector det: spec.clients[0].parameters.fast.limti")


def test_a_detectors_own_streams_are_checked() -> None:
    wrong = detector().model_copy(deep=True)
    raw = {**wrong.to_json(), "metadata": {"name": "det"}}
    raw["spec"]["streams"][0]["stamp"] = "msg.t +"
    found = detector_findings(Detector.model_validate(raw))
    assert "spec.streams[0].stamp" in found.problems[0]
    assert detector_findings(detector()) == Findings()


def test_templates_of_the_guide_have_no_findings() -> None:
    assert template_findings(template(parameters=REGION, key="${parameters.region}"), Policy()) == Findings()


@pytest.mark.parametrize(
    ("spec", "parts"),
    [
        ({"manifests": [container(image="app:${parameters.version}")]}, ["image", "`parameters.version` does not"]),
        ({"manifests": [container(args=["${parameters.rate + 'x'}"])]}, ["args[0]", "column 19", "`+` does not take"]),
        ({"configuration": {"a.yaml": "${parameters.rate.fast}"}}, ["spec.configuration.a.yaml"]),
        ({"helm": {"chart": "/charts/a", "values": {"rate": "${parameters.raet}"}}}, ["spec.helm.values.rate", "raet"]),
        ({"key": "${parameters.regoin}"}, ["spec.key", "regoin", "region"]),
        ({"key": "${parameters.region + 1}"}, ["spec.key", "`+` does not take"]),
        ({"key": "${parameters.region}", "manifests": [{**DEPLOYMENT, "metadata": {"name": "fixed"}}]},
         ["spec.manifests[0].metadata.name: 'fixed'", "must contain ${instance.name}"]),
        ({"manifests": [{**DEPLOYMENT, "metadata": {"name": "${instance.name}_A"}}]}, ["app_A", "at most 253"]),
        ({"manifests": [{**DEPLOYMENT, "metadata": {"name": "a", "namespace": "kube-system"}}]},
         ["spec.manifests[0].metadata.namespace: 'kube-system'", "remove the field"]),
        ({"manifests": [{**DEPLOYMENT, "apiVersion": "rbac.authorization.k8s.io/v1", "kind": "Role"}]},
         ["spec.manifests[0].kind", "administrator allows"]),
        ({"manifests": [DEPLOYMENT, DEPLOYMENT]}, ["spec.manifests", "is given twice"]),
        ({"manifests": [container(args=["${10 / (parameters.rate - 10) > 1 ? parameters.list[3] : 'x'}"])]},
         ["args[0]", "no index 3"]),
    ],
)  # fmt: skip
def test_errors_independent_of_tasks_are_problems_of_the_template(spec: dict[str, Any], parts: list[str]) -> None:
    rate = {"rate": {"type": "number", "default": 10}, "list": {"type": "array", "default": ["a"]}}
    found = template_findings(template(parameters={**REGION, **rate}, **spec), Policy())
    assert len(found.problems) == 1
    assert [part for part in parts if part not in found.problems[0]] == []


def test_errors_that_depend_on_values_of_tasks_are_warnings() -> None:
    declared = {**REGION, "lane": {"type": "string"}}
    made = template(parameters=declared, manifests=[container(args=["l=${parameters.lane}"])])
    found = template_findings(made, Policy())
    assert not found.problems
    assert len(found.remarks) == 1
    for part in ("args[0]", "`parameters.lane` is null", "when tasks give only region"):
        assert part in str(found.remarks[0])
    metadata = made.metadata.model_copy(update={"annotations": {IGNORE_ANNOTATION: "failing-example"}})
    assert template_findings(made.model_copy(update={"metadata": metadata}), Policy()) == Findings()


@pytest.mark.parametrize(
    "parameter",
    [{"type": "string", "pattern": "^[0-9]+$"}, {"type": "array", "items": "string"}, {"type": "object"}],
    ids=["pattern", "array", "object"],
)
def test_values_of_unknown_shape_give_no_findings(parameter: dict[str, Any]) -> None:
    expression = {
        "string": "${10 / double(parameters.x)}",
        "array": "${parameters.x[4]}",
        "object": "${parameters.x.a}",
    }
    manifest = container(args=[expression[parameter["type"]]])
    made = template(parameters={"x": {"required": True, **parameter}}, manifests=[manifest])
    assert template_findings(made, Policy()) == Findings()


def test_a_name_from_a_text_parameter_is_not_a_problem() -> None:
    named = {**DEPLOYMENT, "metadata": {"name": "${instance.name}-${parameters.region}"}}
    assert template_findings(template(parameters=REGION, manifests=[named]), Policy()) == Findings()
    twice = [named, {**named, "metadata": {"name": "${instance.name}-${parameters.lane}"}}]
    declared = {**REGION, "lane": {"type": "string", "required": True}}
    assert not template_findings(template(parameters=declared, manifests=twice), Policy()).problems


def test_a_template_of_too_many_expressions_is_refused_before_any_is_compiled() -> None:
    data = {f"key{number}": "${parameters.region} $${HOME}" for number in range(MOST_EXPRESSIONS)}
    manifest = {"apiVersion": "v1", "kind": "ConfigMap", "metadata": {"name": "a"}, "data": data}
    assert not template_findings(template(parameters=REGION, manifests=[manifest]), Policy()).problems
    more = {**manifest, "metadata": {"name": "${instance.name}"}}
    (problem,) = template_findings(template(parameters=REGION, manifests=[more]), Policy()).problems
    assert problem.startswith("spec: has 1001 expressions")


def test_errors_with_the_baseline_are_problems() -> None:
    declared, args = {"lane": {"type": "string"}}, ["l=${parameters.lane}"]
    spec = {"parameters": declared, "manifests": [container(args=args)]}
    found = template_findings(template(**spec, baseline={}), Policy())
    assert "`parameters.lane` is null" in found.problems[0]
    assert not template_findings(template(**spec, baseline={"parameters": {"lane": "a"}}), Policy()).problems


def deploying(of: str = "app", operation: str = "Deploy", **parameters: Any) -> EventRule:
    deploy = {"templateName": of, "operation": operation, "parameters": parameters}
    return rule(actions=[{"name": "run", "deploy": deploy}])


@pytest.mark.parametrize(
    ("requested", "parts"),
    [
        (deploying("ap", region="x"), ["spec.actions[0].deploy.templateName: there is no", "mean app?"]),
        (deploying("other", region="x"), ["create it; until then, tasks of this rule are refused"]),
        (deploying(regoin="x", region="${client}"), ["deploy.parameters.regoin", "did you mean region?"]),
        (deploying(regoin="${client}", region="x"), ["deploy.parameters.regoin", "did you mean region?"]),
        (deploying(region="x", rate=99), ["deploy.parameters.rate: 99 is above the maximum of 50"]),
        (deploying(rate=3), ["deploy.parameters.region: is missing", "requires it"]),
    ],
)  # fmt: skip
def test_rejections_expected_for_a_rules_tasks_are_warnings(requested: EventRule, parts: list[str]) -> None:
    app = template(parameters={**REGION, "rate": {"type": "number", "maximum": 50}})
    (found,) = deploy_remarks(requested, [app])
    assert [part for part in parts if part not in str(found)] == []
    metadata = requested.metadata.model_copy(update={"annotations": {IGNORE_ANNOTATION: f"x, {found.check}"}})
    assert not deploy_remarks(requested.model_copy(update={"metadata": metadata}), [app])


def test_valid_task_values_give_no_warning() -> None:
    app = template(parameters={**REGION, "rate": {"type": "number", "maximum": 50}})
    assert not deploy_remarks(deploying(region="${client}", rate="${speed}"), [app])
    assert not deploy_remarks(deploying(operation="Reconfigure", rate=3), [app])
    assert not deploy_remarks(deploying("wrong"), [app], ["wrong"])
    assert not deploy_remarks(rule(), [])
