"""Manual annotations: a paused instance is not changed, a held one stays without demand."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.core.conditions import ConditionState
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.demand import VerdictKind, demand
from application_manager.core.demand.lingering import (
    HOLD_ANNOTATION,
    PAUSE_ANNOTATION,
    is_held,
    is_paused,
    manual_conditions,
)
from application_manager.core.statuses.status import instance_status
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.api import ApplicationInstance
from wayside.api.applicationinstance import ApplicationInstanceStatus

RATE = {"parameters": {"rate": {"type": "number", "merge": "Max"}}}


def decided(existing: ApplicationInstance, *tasks: Any) -> Decision:
    return demand([template(**RATE)], tasks, [existing], {}, NOW).instances["app"]


def annotated(annotation: str, value: str = "true", **more: Any) -> ApplicationInstance:
    return instance(annotations={annotation: value}, **more)


@pytest.mark.parametrize(("value", "counts"), [("", True), ("true", True), ("anna, measuring", True), ("False", False)])
def test_an_annotation_counts_with_any_value_except_false(value: str, counts: bool) -> None:
    assert is_paused(annotated(PAUSE_ANNOTATION, value)) is counts
    assert is_held(annotated(HOLD_ANNOTATION, value)) is counts


def test_a_held_instance_is_not_released_and_lingers_once_the_hold_is_removed() -> None:
    assert decided(annotated(HOLD_ANNOTATION, release_at=NOW - 5)).release_time is None
    assert decided(instance()).release_time == NOW + 30


def test_a_held_instance_serves_demands_normally() -> None:
    decision = decided(annotated(HOLD_ANNOTATION), task("a", {"rate": 5}))
    assert (decision.parameters, decision.tasks) == ({"rate": 5}, ("a",))


def test_a_paused_instance_keeps_its_values_and_is_not_released() -> None:
    paused = annotated(PAUSE_ANNOTATION, parameters={"rate": 3})
    assert (decided(paused).release_time, decided(paused).paused, decided(paused).withheld) == (None, True, False)
    decision = decided(paused, task("a", {"rate": 5}))
    assert (decision.parameters, decision.paused, decision.withheld) == (None, True, True)
    assert decision.verdicts["a"].kind is VerdictKind.COUNTS
    assert not decided(paused, task("a", {"rate": 3})).withheld


def test_a_manually_created_instance_can_be_paused_too() -> None:
    assert decided(annotated(PAUSE_ANNOTATION, by_person=True)).paused


def test_the_status_reports_pause_and_hold_and_their_end() -> None:
    assert list(manual_conditions(instance())) == []
    held = annotated(HOLD_ANNOTATION, "anna, measuring")
    (state,) = manual_conditions(held)
    assert (state.type, state.holds) == ("Held", True)
    assert "anna, measuring" in state.message
    well = ConditionState("Applied", True, "Applied"), ConditionState("Ready", True, "Ready")
    status = instance_status(held, decided(held), *well, (), None, NOW, 0)
    assert {each.type: each.status for each in status.conditions} == {
        "Applied": "True",
        "Ready": "True",
        "Held": "True",
    }
    later = instance().model_copy(update={"status": ApplicationInstanceStatus.model_validate(status)})
    (state,) = manual_conditions(later)
    assert (state.type, state.holds, state.reason) == ("Held", False, "NotHeld")
