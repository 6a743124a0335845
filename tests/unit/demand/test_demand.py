"""Demand depends only on the live tasks."""

from __future__ import annotations

from typing import Any

import pytest

from application_manager.core.claims.operations import VerdictKind
from application_manager.core.demand.demand import NamespaceOutcome, demand
from application_manager.core.holders.leases import LeaseView
from tests.unit.manager_objects import NOW, instance, task, template

FUSION = {
    "parameters": {
        "region": {"type": "string", "required": True},
        "sources": {"type": "array", "items": "string", "merge": "Union"},
        "rateHz": {"type": "number", "default": 10, "minimum": 1, "maximum": 50, "merge": "Max"},
        "delay": {"type": "integer", "merge": "Min"},
        "mode": {"type": "string", "default": "plain", "merge": "HighestPriority"},
        "model": {"type": "string", "merge": "Same"},
    },
    "key": "${parameters.region}",
}


def of(*tasks: Any, **others: Any) -> NamespaceOutcome:
    templates = others.pop("templates", [template(**FUSION)])
    return demand(templates, tasks, others.pop("instances", []), others.pop("leases", {}), others.pop("now", NOW))


def only(outcome: NamespaceOutcome) -> Any:
    assert len(outcome.instances) == 1, outcome.instances
    return next(iter(outcome.instances.values()))


# --- Identity


def test_tasks_with_one_key_share_an_instance_and_others_get_their_own() -> None:
    outcome = of(task("a", {"region": "north"}), task("b", {"region": "north"}), task("c", {"region": "south"}))
    assert sorted(each.tasks for each in outcome.instances.values()) == [("a", "b"), ("c",)]
    assert {each.key for each in outcome.instances.values()} == {"north", "south"}


def test_a_template_without_a_key_has_one_instance_of_its_own_name() -> None:
    decision = only(of(task("a"), task("b"), templates=[template("recorder-x"), template()]))
    assert (decision.name, decision.key, decision.tasks) == ("app", None, ("a", "b"))


def test_a_keyed_name_is_the_templates_and_ten_characters_that_never_change() -> None:
    assert only(of(task("a", {"region": "north"}))).name == "app-3q3f46oudt"


def test_a_list_as_key_is_its_json() -> None:
    spec = {"parameters": {"pair": {"type": "array", "items": "string"}}, "key": "${parameters.pair}"}
    decision = only(of(task("a", {"pair": ["car1", "car2"]}), templates=[template(**spec)]))
    assert decision.key == '["car1","car2"]'


def test_a_key_without_a_value_is_refused_with_the_remedy() -> None:
    spec = {"parameters": {"region": {"type": "string"}}, "key": "${parameters.region}"}
    verdict = of(task("a"), templates=[template(**spec)]).verdicts["a"]
    assert (verdict.kind, verdict.reason) == (VerdictKind.REFUSED, "InvalidKey")
    assert "is null for this task" in verdict.message
    assert "give the parameters" in verdict.message


# --- Merging


def test_each_merge_strategy_gives_its_result() -> None:
    decision = only(
        of(
            task("low", {"region": "n", "sources": ["b", "a"], "rateHz": 20, "delay": 7, "mode": "low"}),
            task("high", {"region": "n", "sources": ["c", "a"], "rateHz": 5, "delay": 3, "mode": "high"}, priority=5),
        )
    )
    assert decision.parameters == {
        "region": "n",
        "sources": ["a", "b", "c"],
        "rateHz": 20,
        "delay": 3,
        "mode": "high",
    }
    assert decision.tasks == ("high", "low")


def test_a_default_applies_only_if_no_task_sets_the_parameter() -> None:
    assert only(of(task("a", {"region": "n"}))).parameters == {"region": "n", "rateHz": 10, "mode": "plain"}
    assert only(of(task("a", {"region": "n", "rateHz": 2}))).parameters["rateHz"] == 2


def test_with_strategy_same_a_differing_task_contributes_nothing() -> None:
    first = task("first", {"region": "n", "model": "small", "sources": ["a"]})
    later = task("later", {"region": "n", "model": "large", "sources": ["b"], "rateHz": 50}, created=1)
    outcome = of(later, first)
    assert only(outcome).parameters == {
        "region": "n",
        "model": "small",
        "sources": ["a"],
        "rateHz": 10,
        "mode": "plain",
    }
    verdict = outcome.verdicts["later"]
    assert (verdict.kind, verdict.reason, verdict.instance) == (VerdictKind.REFUSED, "Conflict", None)
    for part in ("spec.parameters.model", '"large"', '"small"', "task first", "give the same value"):
        assert part in verdict.message


def test_higher_priority_wins_then_age_then_name() -> None:
    parameters = [{"region": "n", "model": model} for model in ("x", "y", "z")]
    oldest = task("c", parameters[0], created=0)
    name_first = task("a", parameters[1], created=1)
    assert only(of(name_first, oldest)).parameters["model"] == "x"
    assert only(of(name_first, oldest, task("z", parameters[2], created=2, priority=1))).parameters["model"] == "z"
    assert only(of(task("b", parameters[0]), task("a", parameters[1]))).parameters["model"] == "y"


def test_a_conflict_is_resolved_when_the_other_task_ends() -> None:
    first = {"region": "n", "model": "small"}
    later = task("later", {"region": "n", "model": "large"}, created=1)
    assert only(of(task("first", first), later)).tasks == ("first",)
    assert only(of(task("first", first, ended=True), later)).tasks == ("later",)


def test_numbers_equal_by_value_agree_and_merge_into_one_item() -> None:
    spec = {"parameters": {"n": {"type": "number"}, "list": {"type": "array", "merge": "Union"}}}
    outcome = of(
        task("a", {"n": 1, "list": [1, "1", True, None]}),
        task("b", {"n": 1.0, "list": [1.0, False, [2], {"k": 0}]}),
        templates=[template(**spec)],
    )
    assert only(outcome).parameters["n"] == 1
    assert only(outcome).parameters["list"] == [None, False, True, 1, "1", [2], {"k": 0}]


# --- Refusals


@pytest.mark.parametrize(
    ("parameters", "parts"),
    [
        ({"region": 3}, ["spec.parameters.region: 3 is not of type string", "give a value of type string"]),
        ({}, ["spec.parameters.region: is missing", "template app requires it"]),
        ({"region": None}, ["spec.parameters.region: is missing"]),
        ({"region": "n", "rateHz": 51}, ["spec.parameters.rateHz: 51 is above the maximum of 50", "at most 50"]),
        ({"region": "n", "sources": ["a", 1]}, ["spec.parameters.sources: item 1, 1, is not of type string"]),
        ({"region": "n", "delay": 1.5}, ["spec.parameters.delay: 1.5 is not of type integer"]),
        ({"region": "n", "sorces": []}, ["spec.parameters.sorces: [] is given", "did you mean sources?"]),
    ],
)
def test_a_value_that_does_not_fit_is_refused_with_field_value_and_remedy(
    parameters: dict[str, Any], parts: list[str]
) -> None:
    outcome = of(task("a", parameters), task("good", {"region": "n"}))
    verdict = outcome.verdicts["a"]
    assert (verdict.kind, verdict.reason) == (VerdictKind.REFUSED, "InvalidParameters")
    for part in parts:
        assert part in verdict.message
    assert only(outcome).tasks == ("good",)


def test_more_than_64_kib_are_refused() -> None:
    spec = {"parameters": {"text": {"type": "string"}}}
    room = 64 * 1024 - len('{"text":""}')
    fits = of(task("a", {"text": "x" * room}), templates=[template(**spec)])
    assert fits.verdicts["a"].kind is VerdictKind.COUNTS
    over = of(task("a", {"text": "x" * (room + 1)}), templates=[template(**spec)])
    assert over.verdicts["a"].reason == "InvalidParameters"
    assert "65537 bytes" in over.verdicts["a"].message


def test_an_unknown_template_is_named_and_affects_no_other_task() -> None:
    outcome = of(task("a", of="nowhere"), task("b", {"region": "n"}))
    assert outcome.verdicts["a"].reason == "TemplateNotFound"
    assert "'nowhere'" in outcome.verdicts["a"].message
    assert only(outcome).tasks == ("b",)


def test_a_manually_created_instance_is_neither_changed_nor_released() -> None:
    mine = instance(by_person=True, parameters={"n": 1})
    outcome = of(task("a"), templates=[template()], instances=[mine])
    decision = only(outcome)
    assert (decision.parameters, decision.release_time, decision.demanded) == (None, None, False)
    assert outcome.verdicts["a"].reason == "InstanceNotManaged"


# --- Linger


def test_the_end_of_the_last_demand_starts_the_linger_with_its_parameters() -> None:
    spec = {"lifecycle": {"linger": "20s"}}
    decision = only(of(task("a", ended=True), templates=[template(**spec)], instances=[instance()]))
    assert (decision.release_time, decision.next_change, decision.parameters) == (NOW + 20, NOW + 20, None)


def test_the_deadline_in_the_status_survives_a_restart() -> None:
    decision = only(of(templates=[template()], instances=[instance(release_at=NOW + 3)], now=NOW + 1))
    assert (decision.release_time, decision.next_change) == (NOW + 3, NOW + 3)


def test_a_new_demand_within_the_linger_ends_it() -> None:
    decision = only(of(task("a"), templates=[template()], instances=[instance(release_at=NOW + 3)]))
    assert (decision.release_time, decision.tasks) == (None, ("a",))


@pytest.mark.parametrize(("annotations", "linger"), [({"wayside.dev/linger": "2s"}, 2), ({}, 30)])
def test_instances_of_a_deleted_template_linger_as_it_defined(annotations: dict[str, str], linger: int) -> None:
    outcome = of(task("a"), templates=[], instances=[instance(annotations=annotations)])
    assert only(outcome).release_time == NOW + linger
    assert outcome.verdicts["a"].reason == "TemplateNotFound"


# --- Lost holders

RELEASE = {"lifecycle": {"onDetectorLoss": {"policy": "Release", "after": "10s"}}}
HOLD = {"lifecycle": {"onDetectorLoss": {"policy": "Hold"}}}


def lost(unchanged: float, spec: dict[str, Any] = RELEASE, *, renewed: bool = True, **more: Any) -> NamespaceOutcome:
    held = more.pop("held", task("a", holder="det"))
    return of(held, templates=[template(**spec)], leases={"det": LeaseView(unchanged, 15, renewed)}, **more)


def test_a_holder_counts_until_its_lease_was_not_renewed_for_its_duration_and_the_grace_period() -> None:
    before = lost(24.9)
    assert only(before).tasks == ("a",)
    assert only(before).next_change == pytest.approx(NOW + 0.1)
    verdict = lost(25).verdicts["a"]
    assert (verdict.kind, verdict.reason) == (VerdictKind.LAPSED, "HolderLost")
    assert lost(25).instances == {}


def test_policy_hold_and_tasks_without_a_holder_never_lapse() -> None:
    assert only(lost(10_000, HOLD)).tasks == ("a",)
    assert only(lost(10_000, held=task("a"))).tasks == ("a",)


def test_after_a_restart_a_lost_holder_stays_lost_until_it_renews() -> None:
    held = task("a", holder="det", accepted_condition=("False", "HolderLost", NOW - 60))
    assert lost(0, held=held, renewed=False).verdicts["a"].kind is VerdictKind.LAPSED
    assert lost(0, held=held, renewed=True).verdicts["a"].kind is VerdictKind.COUNTS


def test_a_holder_lost_for_over_an_hour_finishes_its_tasks_until_it_returns() -> None:
    held = task("a", holder="det", accepted_condition=("False", "HolderLost", NOW - 3600))
    verdict = lost(3700, held=held).verdicts["a"]
    assert (verdict.kind, verdict.reason) == (VerdictKind.FINISHED, "DetectorLost")
    assert lost(0, held=held).verdicts["a"].kind is VerdictKind.COUNTS


def test_values_of_a_lost_holder_are_not_merged() -> None:
    outcome = of(
        task("a", {"region": "n", "model": "small"}, holder="det"),
        task("b", {"region": "n", "model": "large"}, created=1),
        leases={"det": LeaseView(100, 15)},
    )
    assert only(outcome).parameters["model"] == "large"
