"""Merging: the laws of each strategy, and which values and templates are refused."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from application_manager.core.claims.claims import claim
from application_manager.core.claims.merging import Contribution, merge
from application_manager.core.conditions import ConditionState
from application_manager.core.demand.demand import demand
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer, RenderError
from application_manager.core.statuses.status import instance_status
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.api.parameter import Parameter

NUMBERS = st.integers(-5, 5) | st.floats(-5, 5, allow_nan=False)
LISTS = st.lists(st.sampled_from(["a", "b", "c", 1, 1.0, True]), max_size=4)
KINDS: dict[str, tuple[str, st.SearchStrategy[Any]]] = {
    "Union": ("array", LISTS),
    "Intersection": ("array", LISTS),
    "Max": ("number", NUMBERS),
    "Min": ("number", NUMBERS),
    "Sum": ("number", NUMBERS),
    "All": ("boolean", st.booleans()),
    "Any": ("boolean", st.booleans()),
}
IDEMPOTENT = sorted(KINDS.keys() - {"Sum"})


def parameter(strategy: str, **more: Any) -> Parameter:
    return Parameter.model_validate({"type": KINDS[strategy][0], "merge": strategy, **more})


def merged(declared: Parameter, *logged: Any) -> Any:
    contributions = [Contribution(f"t{index}", {"p": value}) for index, value in enumerate(logged)]
    return merge({"p": declared}, contributions).parameters.get("p")


# --- Laws


@pytest.mark.parametrize("strategy", sorted(KINDS))
@given(data=st.data(), source=st.randoms())
def test_the_order_does_not_matter(strategy: str, data: st.DataObject, source: random.Random) -> None:
    logged = data.draw(st.lists(KINDS[strategy][1], min_size=1, max_size=5))
    shuffled = list(logged)
    source.shuffle(shuffled)
    assert merged(parameter(strategy), *logged) == merged(parameter(strategy), *shuffled)


@pytest.mark.parametrize("strategy", IDEMPOTENT)
@given(data=st.data())
def test_a_duplicated_value_does_not_change_the_result(strategy: str, data: st.DataObject) -> None:
    logged = data.draw(st.lists(KINDS[strategy][1], min_size=1, max_size=5))
    assert merged(parameter(strategy), *logged, logged[0]) == merged(parameter(strategy), *logged)


@pytest.mark.parametrize("strategy", IDEMPOTENT)
@given(data=st.data())
def test_merging_in_steps_is_as_merging_at_once(strategy: str, data: st.DataObject) -> None:
    first, second, third = (data.draw(KINDS[strategy][1]) for _ in range(3))
    declared = parameter(strategy)
    assert merged(declared, merged(declared, first, second), third) == merged(declared, first, second, third)


@given(LISTS, LISTS)
def test_an_intersection_is_in_each_and_each_is_in_the_union(one: list[Any], other: list[Any]) -> None:
    both, either = merged(parameter("Intersection"), one, other), merged(parameter("Union"), one, other)
    assert all(item in one and item in other for item in both)
    assert all(item in either for item in (*one, *other))


def test_an_intersection_of_nothing_in_common_is_empty() -> None:
    assert merged(parameter("Intersection"), ["b", "a"], ["c"]) == []
    assert merged(parameter("Intersection"), ["b", "a", "b"], ["a", "b", "c"]) == ["a", "b"]


def test_a_sum_is_exact_and_is_an_integer_where_it_can_be() -> None:
    assert merged(parameter("Sum"), *[0.1] * 10) == pytest.approx(1)
    assert merged(parameter("Sum"), 1e16, 1, -1e16) == 1  # floats added in this order give 0
    assert str(merged(parameter("Sum"), 0.5, 0.5, 2)) == "3"
    assert merged(parameter("Sum"), 1e308, 1e308) == merged(parameter("Max"), 1.7976931348623157e308)


@given(st.lists(st.integers(0, 9), min_size=1, max_size=6), st.integers(9, 30))
def test_a_sum_is_capped_at_the_maximum_and_reported(logged: list[int], maximum: int) -> None:
    declared = {"p": parameter("Sum", minimum=0, maximum=maximum)}
    result = merge(declared, [Contribution(str(index), {"p": value}) for index, value in enumerate(logged)])
    assert result.parameters["p"] == min(sum(logged), maximum)
    assert bool(result.capped) == (sum(logged) > maximum)


def test_the_instance_reports_when_a_sum_is_capped_and_no_longer_capped() -> None:
    bandwidth = {"type": "number", "merge": "Sum", "maximum": 50, "description": "Mbit/s"}
    templates = [template(parameters={"rate": bandwidth})]
    here = instance()

    def after(*rates: int) -> Any:
        nonlocal here
        tasks = [task(f"t{index}", {"rate": rate}) for index, rate in enumerate(rates)]
        (decision,) = demand(templates, tasks, [here], {}, NOW).instances.values()
        applied = ConditionState("Applied", True, "Applied")
        status = instance_status(here, decision, applied, applied, [], None, NOW, 0)
        here = here.model_copy(update={"status": status})
        logged = {each.type: (each.status, each.message) for each in status.conditions}.get("Capped")
        return (decision.parameters or {}).get("rate"), logged

    assert after(20) == (20, None)
    assert after(20, 40) == (50, ("True", "rate: the sum of 2 values, 60, is capped at the maximum of 50"))
    assert after(20) == (20, ("False", "no merged value is capped"))


@given(st.lists(st.tuples(st.sampled_from(["x", "y"]), NUMBERS), min_size=1, max_size=5))
def test_with_strategy_same_all_contributing_tasks_agree(logged: list[tuple[str, Any]]) -> None:
    declared = {
        "same": Parameter.model_validate({"type": "string"}),
        "max": Parameter.model_validate({"type": "number", "merge": "Max"}),
    }
    contributions = [Contribution(str(i), {"same": same, "max": number}) for i, (same, number) in enumerate(logged)]
    result = merge(declared, contributions)
    taking_part = [each for each in contributions if each.task not in result.conflicts]
    assert {each.parameters["same"] for each in taking_part} == {logged[0][0]} == {result.parameters["same"]}
    assert result.parameters["max"] == max(each.parameters["max"] for each in taking_part)


# --- Valid templates and tasks


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"type": "string", "merge": "Union"}, "merge Union needs type array; got string"),
        ({"type": "object", "merge": "Intersection"}, "merge Intersection needs type array; got object"),
        ({"type": "string", "merge": "Sum"}, "merge Sum needs type number or integer; got string"),
        ({"type": "number", "merge": "All"}, "merge All needs type boolean; got number"),
        ({"type": "array", "merge": "Any"}, "merge Any needs type boolean; got array"),
        ({"type": "number", "minimum": 2, "maximum": 1}, "minimum must not be above maximum 1; got 2"),
        ({"type": "number", "pattern": "a"}, "pattern needs type string"),
        ({"type": "array", "pattern": "a"}, "pattern needs type string, or type array with items string; got array"),
        ({"type": "number", "merge": "Sum", "enum": [1, 2]}, "can produce values"),
        ({"type": "number", "enum": [1, "2"]}, r"enum\[1\]: '2' is not of type number"),
        ({"type": "integer", "minimum": 2, "default": 1}, "default: 1 is below the minimum of 2"),
        ({"type": "string", "default": "a", "required": True}, "remove required or default"),
    ],
)
def test_an_invalid_parameter_definition_is_rejected(spec: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Parameter.model_validate(spec)


REGIONS = {"type": "array", "items": "string", "pattern": "^[a-z]+$", "merge": "Union"}


@pytest.mark.parametrize(
    ("spec", "value", "problem"),
    [
        ({"type": "string", "pattern": "^rsu-[0-9]+$"}, "rsu-12", None),
        ({"type": "string", "pattern": "^rsu-[0-9]+$"}, "car", '"car" does not match the pattern ^rsu-[0-9]+$'),
        ({"type": "string", "pattern": "a"}, "b\0a", "does not match"),
        (REGIONS, ["north", "south"], None),
        (REGIONS, ["north", "S"], 'item 1, "S", does not match the pattern ^[a-z]+$: give a value of type array'),
        ({"type": "string", "enum": ["x", "y"]}, "z", "'z' is not one of 'x', 'y': give a value of type string one of"),
    ],
)
def test_a_value_is_matched_with_pattern_and_enum(spec: dict[str, Any], value: Any, problem: str | None) -> None:
    result = claim(template(parameters={"p": spec}), task("a", {"p": value}))
    message = getattr(result, "message", None)
    assert message is None if problem is None else problem in str(message)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"type": "string", "pattern": "("}, r'spec.parameters.p.pattern: "\(" is not a regular .*missing \)'),
        ({"type": "string", "pattern": "^a", "default": "b"}, r'spec.parameters.p.default: "b" does not match'),
    ],
)
def test_a_template_with_a_wrong_pattern_is_reported(spec: dict[str, Any], message: str) -> None:
    with pytest.raises(RenderError, match=message):
        Renderer(template(parameters={"p": spec}), Policy())
