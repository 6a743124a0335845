"""Errors of a scope or of elements are reported at their field."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from tests.driving import POSITION, SPEED, a_detector, a_rule, a_stream
from wayside.rules import RuleError, compile_rule

EACH = {"as": "site", "of": [{"name": "north", "x": 1}, {"name": "south", "y": 2}]}


def in_pairs(**fields: Any) -> dict[str, Any]:
    return {"scope": {"pairs": {"position": POSITION, "within": 9, **fields}}, "when": "true"}


@pytest.mark.parametrize(
    ("spec", "field", "part"),
    [
        (in_pairs(a={"where": "labels."}), "spec.scope.pairs.a.where", "line 1"),
        (in_pairs(b={"where": "distance < 3"}), "spec.scope.pairs.b.where", "distance"),
        (in_pairs(a={"where": "client"}), "spec.scope.pairs.a.where", "must be a boolean"),
        (
            in_pairs(position={"stream": "pose", "latitude": "msg.lat >", "longitude": "msg.lon"}),
            "spec.scope.pairs.position.latitude",
            "line 1",
        ),
        (
            {
                **in_pairs(position={"stream": "pose", "latitude": "msg.a", "longitude": "msg.o"}),
                "when": "a.position.x > 1",
            },
            "spec.when",
            "a.position has no field x; it has latitude, longitude",
        ),
        (
            {"scope": {"fleet": {"members": "membrs"}}, "when": "true"},
            "spec.scope.fleet.members",
            "line 1",
        ),
        ({"scope": {"fleet": {"members": "true"}}, "when": "size(member) > 1"}, "spec.when", "did you mean `members`?"),
        ({"each": EACH, "when": "site.z > 1"}, "spec.when", "site has no field z; it has name, x, y"),
        (
            {"each": EACH, "signals": [{**SPEED, "value": "msg.v - site.z"}], "when": "true"},
            "spec.signals[0].value",
            "site has no field z",
        ),
        (
            {**in_pairs(position={"stream": "pose", "x": "msg.x - site.x", "y": "0.0"}), "each": EACH},
            "spec.scope.pairs.position.x",
            "site",
        ),
        (
            {"each": {**EACH, "as": "labels"}, "when": "true"},
            "spec.each.as",
            "the scope client already defines the variable",
        ),
        ({"each": {**EACH, "as": "for"}, "when": "true"}, "spec.each.as", "for is a reserved word of CEL"),
        ({"each": {**EACH, "as": "speed"}, "signals": [SPEED], "when": "true"}, "spec.each.as", "the name of a signal"),
        ({"each": {**EACH, "as": "msg"}, "when": "true"}, "spec.each.as", "a sample already defines the variable"),
        ({**in_pairs(), "signals": [{**SPEED, "name": "closingSpeed"}]}, "spec.signals[0].name", "closingSpeed"),
    ],
)
def test_a_problem_names_its_field(spec: dict[str, Any], field: str, part: str) -> None:
    with pytest.raises(RuleError) as caught:
        compile_rule(a_rule(**spec), a_detector())
    assert [
        str(problem) for problem in caught.value.problems if str(problem).startswith(field) and part in str(problem)
    ]


@pytest.mark.parametrize(
    ("spec", "part"),
    [
        ({"scope": {}}, "exactly one of client, pairs and fleet"),
        ({"scope": {"client": {}, "fleet": {"members": "true"}}}, "exactly one of client, pairs and fleet"),
        (in_pairs(position={"stream": "pose", "x": "msg.x"}), "give x and y"),
        (in_pairs(position={"stream": "pose", "x": "1", "y": "1", "latitude": "1"}), "give x and y"),
        (in_pairs(position={"stream": "pose", "latitude": "1", "longitude": "1", "z": "1"}), "latitude and longitude"),
        (in_pairs(maxPairs=0), "greater than or equal to 1"),
        ({"each": {"as": "site", "of": [{"name": "x"}, {"name": "x"}]}}, "the name 'x' is used twice"),
        ({"each": {"as": "site", "of": [{"x": 1}]}}, "name"),
        ({"each": {"as": "site", "of": []}}, "at least 1"),
        ({"each": {"as": "site", "of": [{"name": "a b"}]}}, "pattern"),
    ],
)
def test_values_forbidden_by_the_schema_are_rejected(spec: dict[str, Any], part: str) -> None:
    with pytest.raises(ValidationError, match=part):
        a_rule(**{"when": "true", **spec})


def test_the_closing_speed_needs_more_than_a_second_of_positions() -> None:
    detector = a_detector(a_stream("pose", buffer={"duration": "1s"}))
    asking = {"name": "x", "deploy": {"templateName": "t", "parameters": {"v": "${closingSpeed}"}}}
    for spec in (
        {**in_pairs(), "when": "closingSpeed > 1"},
        in_pairs(where="closingSpeed > 1"),
        {**in_pairs(), "actions": [asking]},
    ):
        with pytest.raises(RuleError, match="kept for 1 s only: raise the"):
            compile_rule(a_rule(**spec), detector)
    compile_rule(a_rule(**in_pairs()), detector)


def test_the_elements_are_part_of_the_rules_meaning() -> None:
    one = compile_rule(a_rule(each=EACH, when="true"), a_detector())
    other = compile_rule(a_rule(each={**EACH, "of": EACH["of"][:1]}, when="true"), a_detector())
    assert one.digest != other.digest
    assert [element.name for element in one.elements] == ["north", "south"]
