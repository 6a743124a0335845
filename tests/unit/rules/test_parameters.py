"""Parameters of a rule: shared by its expressions, overridden for single clients; wrong ones are reported in place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from detector.assembly.checking import findings
from tests.driving import POSITION, Drive, a_deploy, a_detector, a_rule, arrival, compiled
from wayside.api import Detector, EventRule
from wayside.api.documents import load_documents
from wayside.rules import RuleError, compile_rule

SQUARE = [[0, 0], [10, 0], [10, 10], [0, 10]]
FAST = "msg.v > parameters.maxSpeed"
SPEED = {"name": "v", "stream": "speed", "value": "msg.v"}


def too_fast(**spec: Any) -> EventRule:
    return a_rule(
        "too-fast", **{"parameters": {"maxSpeed": 10}, "signals": [SPEED], "when": "v > parameters.maxSpeed", **spec}
    )


def with_values(*clients: tuple[str, dict[str, Any]]) -> Detector:
    return a_detector(clients=[{"name": name, "parameters": {"too-fast": values}} for name, values in clients])


def test_a_client_can_override_a_parameter() -> None:
    drive = Drive(with_values(("truck", {"maxSpeed": 5})), too_fast())
    both = [arrival(0.5, client, {"v": 7}) for client in ("car", "truck")]
    assert drive.take(*both, until=1) == ["too-fast truck started 1"]
    assert drive.take(*[arrival(1.5, client, {"v": 12}) for client in ("car", "truck")], until=2) == [
        "too-fast car started 2"
    ]


def test_signals_scopes_and_actions_see_the_overrides_too() -> None:
    rule = too_fast(
        parameters={"maxSpeed": 10, "area": SQUARE, "role": "guest", "limits": {"near": 3}},
        scope={"client": {"where": 'parameters.role == "guest"'}},
        signals=[
            {"name": "inside", "stream": "pose", "value": "inside(msg.x, msg.y, parameters.area)"},
            {"name": "n", "stream": "speed", "where": FAST, "over": "5s", "aggregate": "Count"},
        ],
        when="inside && n >= parameters.limits.near",
        actions=[a_deploy("go", parameters={"limit": "${parameters.maxSpeed}", "area": "${parameters.area}"})],
    )  # fmt: skip
    moved = [[x + 100, y] for x, y in SQUARE]
    drive = Drive(with_values(("far", {"area": moved}), ("host", {"role": "host"})), rule)
    arrivals = [
        each
        for client, x in (("car", 5), ("far", 105), ("host", 5), ("lost", 105))
        for each in (
            arrival(0.1, client, {"x": x, "y": 10}, "pose"),
            *(arrival(0.1 * i, client, {"v": 11}) for i in range(2, 5)),
        )
    ]
    started = drive.take(*sorted(arrivals, key=lambda each: each.received), until=1)
    assert started == ["too-fast car started 1", "too-fast far started 1"]
    demanded = {demand.episode.subject: demand.parameters for demand in drive.engine.demands().values()}
    assert demanded["car"] == {"limit": 10, "area": SQUARE}
    assert demanded["far"] == {"limit": 10, "area": moved}


def test_in_a_pair_each_client_has_its_parameters_and_the_rule_the_shared_ones() -> None:
    rule = too_fast(
        scope={"pairs": {"position": {**POSITION, "x": "msg.x * parameters.scale"}, "within": 1000}},
        parameters={"gap": 5, "scale": 1},
        when="distance < a.parameters.gap + b.parameters.gap && parameters.gap == 5",
        signals=[],
    )
    drive = Drive(with_values(("b", {"gap": 50}), ("c", {"scale": 100})), rule)
    placed = [arrival(0.5, name, {"x": x, "y": 0}, "pose") for name, x in (("a", 0), ("b", 40), ("c", 1))]
    assert drive.take(*placed, until=1) == ["too-fast a+b started 1"]
    assert drive.events[0].values["distance"] == 40


def test_the_members_of_a_fleet_have_their_own_parameters() -> None:
    rule = too_fast(
        scope={"fleet": {"members": "v > parameters.maxSpeed"}},
        when="size(members) == 1 && members[0].parameters.maxSpeed < parameters.maxSpeed",
    )
    drive = Drive(with_values(("truck", {"maxSpeed": 5})), rule)
    both = [arrival(0.5, client, {"v": 7}) for client in ("car", "truck")]
    assert drive.take(*both, until=1) == ["too-fast ~fleet started 1"]


def test_a_change_of_parameters_is_a_change_of_the_rule_wherever_it_is_made() -> None:
    first, second = with_values(), with_values(("truck", {"maxSpeed": 5}))
    drive = Drive(first, too_fast())
    assert drive.take(arrival(0.5, "car", {"v": 12}), until=1) == ["too-fast car started 1"]
    assert drive.note(drive.engine.set_rules(compiled(first, too_fast(description="other words")))) == []
    assert drive.note(drive.engine.set_rules(compiled(first, too_fast(parameters={"maxSpeed": 11})))) == [
        "too-fast car RuleChanged 1"
    ]
    assert drive.take(until=2) == ["too-fast car started 2"]
    assert drive.note(drive.engine.set_rules(compiled(second, too_fast(parameters={"maxSpeed": 11})))) == [
        "too-fast car RuleChanged 2"
    ]


@pytest.mark.parametrize(
    ("spec", "field", "parts"),
    [
        ({"when": "v > parameters.maxSped"}, "spec.when", ["no field maxSped", "did you mean maxSpeed?"]),
        ({"parameters": {}}, "spec.when", ["no field maxSpeed", "it has no fields"]),
        ({"signals": [{**SPEED, "value": "msg.v + parameters.of"}]}, "spec.signals[0].value", ["no field of"]),
        (
            {"signals": [{**SPEED, "name": "parameters"}]},
            "spec.signals[0].name",
            ["variable parameters: the rule's parameters", "such as parametersValue"],
        ),
        (
            {"actions": [a_deploy("go", parameters={"x": "${parameters.y}"})]},
            "spec.actions[0].deploy.parameters.x",
            ["no field y"],
        ),
        (
            {"scope": {"pairs": {"position": POSITION, "within": 9}}, "when": "a.parameters.maxSped > 1"},
            "spec.when",
            ["a.parameters has no field maxSped", "did you mean maxSpeed?"],
        ),
        ({"when": "v > 3 &&\n parameters.maxSpeed == 'x'"}, "spec.when", ["line 2, column 22", "(double, string)"]),
        ({"when": "parameters.maxSpeed"}, "spec.when", ["must be a boolean; got a number"]),
        (
            {"parameters": {"maxSpeed": 10, "role": "guest"}, "when": "parameters.role > 3"},
            "spec.when",
            ["`>` does not take (string, double)"],
        ),
        ({"when": "allZero(parameters.maxSpeed)"}, "spec.when", ["`allZero` does not take (double)"]),
        (
            {"signals": [{**SPEED, "where": "sample.size > 'x'"}]},
            "spec.signals[0].where",
            ["does not take (double, string)"],
        ),
        (
            {"scope": {"pairs": {"position": POSITION, "within": 9}}, "when": "b.parameters.maxSpeed && true"},
            "spec.when",
            ["`&&` does not take", "it takes booleans"],
        ),
        (
            {"actions": [a_deploy("go", parameters={"x": "${parameters.maxSpeed + 'x'}"})]},
            "spec.actions[0].deploy.parameters.x",
            ["`+` does not take (double, string)"],
        ),
    ],
)
def test_a_missing_or_mistyped_parameter_is_reported_at_its_use(
    spec: dict[str, Any], field: str, parts: list[str]
) -> None:
    with pytest.raises(RuleError) as caught:
        compile_rule(too_fast(**spec), a_detector())
    reported_at = {str(problem).split(": ")[0]: str(problem) for problem in caught.value.problems}
    assert all(part in reported_at[field] for part in parts), reported_at


@pytest.mark.parametrize(
    ("own", "values", "field", "parts"),
    [
        ({"near": 1}, {"neer": 1}, "neer", ["EventRule too-fast has no parameter neer", "did you mean near?"]),
        ({}, {"n": 1}, "n", ["has no parameter n", "it has none"]),
        ({"m": 1}, {"m": "1"}, "m", ["m must be a number, as in EventRule too-fast; got a string, '1'"]),
        ({"m": True}, {"m": 1}, "m", ["must be a boolean, as in EventRule too-fast; got a number"]),
        ({"m": SQUARE}, {"m": {"x": 1}}, "m", ["must be a list, as in EventRule too-fast; got a map"]),
        (
            {"m": SQUARE},
            {"m": [[0, 0], [1, "1"]]},
            "m",
            ["m[1][1] must be a number, as in EventRule too-fast; got a string"],
        ),
        (
            {"m": {"a": {"b": 1}}},
            {"m": {"a": {"b": []}}},
            "m",
            ["m.a.b", "must be a number, as in EventRule too-fast; got a list"],
        ),
    ],
)
def test_a_mistyped_client_value_is_reported_by_field_in_the_detector(
    own: dict[str, Any], values: dict[str, Any], field: str, parts: list[str]
) -> None:
    with pytest.raises(RuleError) as caught:
        compile_rule(too_fast(parameters=own, when="true"), with_values(("other", {}), ("car", values)))
    (problem,) = caught.value.problems
    assert problem.path == ("spec", "clients", 1, "parameters", "too-fast", field)
    assert str(problem).startswith(f"Detector d: spec.clients[1].parameters.too-fast.{field}: ")
    assert all(part in problem.message for part in parts), problem.message


def test_has_checks_a_parameter_as_for_any_member() -> None:
    rule = too_fast(when="has(parameters.maxSpeed) && v > parameters.maxSpeed")
    assert Drive(with_values(), rule).take(arrival(0.5, "car", {"v": 12}), until=1) == ["too-fast car started 1"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "m is null: give it a value"),
        ([1, None], "m[1] is null"),
        ({"a": float("nan")}, "m.a must be a finite number; got nan"),
        ([[[[[[1]]]]]], "nested more than 5 levels deep"),
        ("x" * 70_000, "bytes as JSON exceeds the limit of 65536"),
    ],
)
def test_values_unusable_in_expressions_are_rejected(value: object, text: str) -> None:
    with pytest.raises(ValidationError) as caught:
        too_fast(parameters={"m": value})
    assert text in str(caught.value)
    with pytest.raises(ValidationError):
        with_values(("car", {"m": value}))


def test_check_locates_wrong_values_and_unknown_rules_in_the_detectors_file(tmp_path: Path) -> None:
    detector = tmp_path / "detector.yaml"
    detector.write_text(
        """apiVersion: wayside.dev/v1alpha1
kind: Detector
metadata: {name: d}
spec:
  clients:
    - name: truck
      parameters:
        too-fast:
          maxSped: 5
        too-slow: {maxSpeed: 5}
  streams:
    - {name: speed, key: 'vehicles/${client:*}/speed', encoding: json}
"""
    )
    rule = tmp_path / "rule.yaml"
    rule.write_text(
        """apiVersion: wayside.dev/v1alpha1
kind: EventRule
metadata: {name: too-fast}
spec:
  parameters: {maxSpeed: 10}
  signals: [{name: v, stream: speed, value: msg.v}]
  when: v > parameters.maxSpeed
"""
    )
    found = findings(load_documents([detector, rule])).problems
    texts = [str(problem).replace(f"{tmp_path}/", "") for problem in found]
    assert len(texts) == 2
    assert texts[0].startswith("detector.yaml:9:")
    assert "EventRule too-fast has no parameter maxSped; did you mean maxSpeed?" in texts[0]
    assert texts[1].startswith("detector.yaml:10:")
    assert "there is no EventRule too-slow here" in texts[1]
    assert findings(load_documents([detector])).problems == []
