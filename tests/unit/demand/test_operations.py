"""Deploy, Reconfigure, Suspend and the baseline: the running applications depend only on the live tasks."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from application_manager.core.claims.claims import instance_name
from application_manager.core.claims.operations import VerdictKind
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.demand import NamespaceOutcome, demand
from application_manager.core.demand.drafting import draft
from application_manager.core.holders.leases import LeaseView
from application_manager.core.objects.policy import Policy
from application_manager.core.objects.rendering import Renderer, RenderError
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.api import ApplicationInstance, ApplicationTask

FUSION: dict[str, Any] = {
    "parameters": {
        "region": {"type": "string", "required": True},
        "sources": {"type": "array", "items": "string", "merge": "Union"},
        "rateHz": {"type": "number", "default": 10, "maximum": 50, "merge": "Max"},
        "delay": {"type": "integer", "merge": "Min"},
        "load": {"type": "integer", "merge": "Sum", "maximum": 9},
        "model": {"type": "string"},
        "mode": {"type": "string", "merge": "HighestPriority"},
    },
    "key": "${parameters.region}",
}
NORTH, SOUTH = instance_name("app", "north"), instance_name("app", "south")
PLAIN = {"parameters": {**FUSION["parameters"], "region": {"type": "string"}}}


def of(*tasks: ApplicationTask, spec: Any = None, **others: Any) -> NamespaceOutcome:
    templates = others.pop("templates", [template(**(spec or FUSION))])
    return demand(templates, tasks, others.pop("instances", []), others.pop("leases", {}), others.pop("now", NOW))


def deploy(name: str, region: str = "north", **parameters: Any) -> ApplicationTask:
    return task(name, {"region": region, **parameters})


def change(name: str, parameters: dict[str, Any], **more: Any) -> ApplicationTask:
    return task(name, parameters, operation="Reconfigure", **more)


def stop(name: str, parameters: dict[str, Any] | None = None, **more: Any) -> ApplicationTask:
    return task(name, parameters, operation="Suspend", **more)


def values(outcome: NamespaceOutcome, name: str = NORTH) -> dict[str, Any]:
    return {key: value for key, value in (outcome.instances[name].parameters or {}).items() if key != "region"}


# --- Reconfigure


def test_a_reconfiguration_overrides_the_merged_values_until_it_ends() -> None:
    low = change("low", {"region": "north", "rateHz": 2, "sources": ["z"]})
    outcome = of(deploy("a", rateHz=20, sources=["a"]), deploy("b", rateHz=30, sources=["b"]), low)
    assert values(outcome) == {"rateHz": 2, "sources": ["z"]}  # below what the others merge to, and not merged with it
    assert outcome.instances[NORTH].tasks == ("a", "b")
    assert (outcome.verdicts["low"].kind, outcome.verdicts["low"].instance) == (VerdictKind.COUNTS, NORTH)
    ended = change("low", {"region": "north", "rateHz": 2}, ended=True)
    assert values(of(deploy("a", rateHz=20, sources=["a"]), ended)) == {"rateHz": 20, "sources": ["a"]}


def test_reconfigurations_merge_among_themselves() -> None:
    outcome = of(
        deploy("a", model="small"),
        change("x", {"region": "north", "rateHz": 3, "model": "large"}),
        change("y", {"region": "north", "rateHz": 5, "model": "tiny"}, created=1),
        change("z", {"region": "north", "rateHz": 4}, created=2),
    )
    assert values(outcome) == {"rateHz": 4, "model": "large"}
    assert outcome.verdicts["y"].reason == "Conflict"
    assert "task x" in outcome.verdicts["y"].message


def test_a_reconfiguration_starts_nothing_and_waits_visibly() -> None:
    for outcome in (of(change("c", {"region": "north", "rateHz": 2})), of(change("c", {"rateHz": 2}))):
        assert outcome.instances == {}
        verdict = outcome.verdicts["c"]
        assert (verdict.kind, verdict.reason, verdict.instance) == (VerdictKind.WAITING, "NothingRuns", None)
        assert "waits until a Deploy task does" in verdict.message


def test_lingering_instances_are_not_reconfigured() -> None:
    outcome = of(change("c", {"region": "north", "rateHz": 2}), instances=[instance(NORTH, key="north")])
    assert outcome.instances[NORTH].parameters is None
    assert outcome.instances[NORTH].release_time is not None
    assert outcome.verdicts["c"].kind is VerdictKind.WAITING


def test_a_reconfiguration_without_key_parameters_covers_all_instances() -> None:
    outcome = of(deploy("a"), deploy("b", "south"), change("c", {"rateHz": 2}))
    assert [values(outcome, name)["rateHz"] for name in (NORTH, SOUTH)] == [2, 2]
    assert outcome.verdicts["c"].message == f"reconfigures instances {NORTH}, {SOUTH}"
    assert outcome.verdicts["c"].instance is None
    only = of(deploy("a"), deploy("b", "south"), change("c", {"region": "south", "rateHz": 2}))
    assert [values(only, name)["rateHz"] for name in (NORTH, SOUTH)] == [10, 2]


def test_a_reconfiguration_of_all_instances_reports_its_conflicts() -> None:
    here = change("here", {"region": "north", "model": "large"}, priority=1)
    outcome = of(deploy("a"), deploy("b", "south"), here, change("all", {"model": "tiny"}))
    assert (values(outcome)["model"], values(outcome, SOUTH)["model"]) == ("large", "tiny")
    verdict = outcome.verdicts["all"]
    assert (verdict.kind, verdict.instance) == (VerdictKind.COUNTS, SOUTH)
    assert "refused for 1 (the first: spec.parameters.model" in verdict.message
    refused = of(deploy("a"), here, change("all", {"model": "tiny"})).verdicts["all"]
    assert (refused.kind, refused.reason) == (VerdictKind.REFUSED, "Conflict")


TWO = {
    "parameters": {"a": {"type": "string"}, "b": {"type": "string"}, "n": {"type": "number", "merge": "Max"}},
    "key": "${parameters.a}-${parameters.b}",
}


@pytest.mark.parametrize(
    ("wrong", "spec", "reason", "message"),
    [
        (change("c", {"a": "x", "n": 1}), TWO, "InvalidKey", "spec.parameters.b: is missing, but the key"),
        (change("c", {"a": "x", "b": "y"}), TWO, "InvalidParameters", "changes nothing: give at least one"),
        (change("c", {}), TWO, "InvalidParameters", "changes nothing"),
        (change("c", {"rateHz": 99}), FUSION, "InvalidParameters", "99 is above the maximum of 50"),
        (stop("c", {"region": "n", "rateHz": 1}), FUSION, "InvalidParameters", "a Suspend task cannot change"),
    ],
)
def test_a_task_that_cannot_act_on_running_instances_is_rejected(
    wrong: Any, spec: Any, reason: str, message: str
) -> None:
    verdict = of(wrong, spec=spec).verdicts["c"]
    assert (verdict.kind, verdict.reason) == (VerdictKind.REFUSED, reason)
    assert message in verdict.message


def test_a_capped_sum_overridden_by_a_reconfiguration_is_not_reported() -> None:
    heavy = [deploy("a", load=6), deploy("b", load=6)]
    assert of(*heavy).instances[NORTH].capped == (
        "load: the sum of 2 values, 12, is capped at the maximum of 9",
    )  # fmt: skip
    assert of(*heavy, change("c", {"load": 1})).instances[NORTH].capped == ()


# --- Suspend


@pytest.mark.parametrize(("priority", "suspended"), [(1, False), (2, True), (3, True)])
def test_a_suspension_wins_from_the_highest_priority_that_deploys(priority: int, suspended: bool) -> None:
    running = [task("a", {"region": "north"}), task("b", {"region": "north"}, priority=2)]
    outcome = of(*running, stop("s", {"region": "north"}, priority=priority))
    assert outcome.instances[NORTH].suspended is suspended
    assert outcome.instances[NORTH].suspender == ("s" if suspended else None)
    assert ("which task s suspends" in outcome.verdicts["a"].message) == suspended
    if not suspended:
        verdict = outcome.verdicts["s"]
        assert (verdict.kind, verdict.reason) == (VerdictKind.REFUSED, "Outbid")
        assert "spec.priority: 1 is below the priority 2 of task b" in verdict.message


def test_a_rejected_task_outranks_no_other() -> None:
    outcome = of(deploy("a", model="x"), task("b", {"region": "north", "model": "y"}, created=1), stop("s", {}))
    assert outcome.instances[NORTH].suspended is True


def test_a_suspension_covers_all_instances_or_that_of_its_key_and_starts_none() -> None:
    both = [deploy("a"), deploy("b", "south")]
    assert [each.suspended for each in of(*both, stop("s")).instances.values()] == [True, True]
    assert of(*both, stop("s", {"region": "south"})).instances[NORTH].suspended is False
    assert of(stop("s")).verdicts["s"].kind is VerdictKind.WAITING
    assert of(stop("s", {"region": "north"})).verdicts["s"].kind is VerdictKind.WAITING


def test_a_suspended_instance_stays_so_while_it_lingers_unless_it_is_held() -> None:
    stopped = instance(NORTH, key="north", parameters={"region": "north"}, suspended=True)
    assert of(instances=[stopped]).instances[NORTH].suspended is None
    held = stopped.model_copy(
        update={"metadata": stopped.metadata.model_copy(update={"annotations": {"wayside.dev/hold": ""}})}
    )
    assert of(instances=[held]).instances[NORTH].suspended is False


def test_a_lost_holder_suspends_nothing() -> None:
    outcome = of(deploy("a"), stop("s", holder="det"), leases={"det": LeaseView(100, 15)})
    assert outcome.instances[NORTH].suspended is False
    assert outcome.verdicts["s"].kind is VerdictKind.LAPSED


# --- Baseline


def with_baseline(**parameters: Any) -> dict[str, Any]:
    return {**PLAIN, "baseline": {"parameters": parameters}}


def test_a_baseline_runs_without_tasks_and_merges_with_them() -> None:
    spec = with_baseline(sources=["x"], mode="calm", rateHz=1)
    alone = of(spec=spec)
    assert (alone.instances["app"].demanded, alone.instances["app"].tasks) == (True, ())
    assert values(alone, "app") == {"sources": ["x"], "mode": "calm", "rateHz": 1}
    joined = of(task("a", {"sources": ["y"], "mode": "busy"}, priority=-9), spec=spec)
    assert values(joined, "app") == {"sources": ["x", "y"], "mode": "busy", "rateHz": 1}
    assert of(spec=spec, instances=[instance()]).instances["app"].release_time is None


def test_with_strategy_same_tasks_must_agree_with_the_baseline() -> None:
    outcome = of(task("a", {"model": "large"}, priority=9), spec=with_baseline(model="small"))
    assert values(outcome, "app")["model"] == "small"
    assert "of the template's baseline" in outcome.verdicts["a"].message


def test_a_baseline_is_reconfigured_and_suspended_by_any_priority() -> None:
    outcome = of(change("c", {"rateHz": 3}), stop("s", priority=-1_000_000), spec=with_baseline())
    assert (values(outcome, "app")["rateHz"], outcome.instances["app"].suspended) == (3, True)


def test_an_invalid_baseline_is_reported_on_the_template_and_one_with_a_key_is_rejected() -> None:
    with pytest.raises(RenderError, match=r"spec\.baseline\.parameters\.rateHz: 99 is above the maximum of 50"):
        Renderer(template(**with_baseline(rateHz=99)), Policy())
    assert of(spec=with_baseline(rateHz=99)).instances == {}
    with pytest.raises(ValidationError, match="baseline is valid only without key"):
        template(**{**FUSION, "baseline": {}})


# --- Laws

few = settings(max_examples=40)  # each of many evaluations

parameters = st.fixed_dictionaries(
    {},
    optional={
        "sources": st.lists(st.sampled_from("abc"), max_size=2),
        "rateHz": st.sampled_from([1, 2.5, 50]),
        "delay": st.integers(-3, 3),
        "load": st.integers(0, 6),
        "model": st.sampled_from(["small", "large"]),
        "mode": st.sampled_from(["x", "y"]),
    },
)
regions = st.sampled_from(["north", "south"])


@st.composite
def tasks(draw: st.DrawFn) -> list[ApplicationTask]:
    found = []
    for index in range(draw(st.integers(0, 7))):
        more: dict[str, Any] = {"priority": draw(st.integers(0, 2)), "created": draw(st.integers(0, 2))}
        where = {"region": draw(regions)}
        match draw(st.sampled_from(["Deploy", "Deploy", "Reconfigure", "Suspend"])):
            case "Deploy":
                found.append(task(f"t{index}", {**where, **draw(parameters)}, **more))
            case "Reconfigure":
                logged = draw(parameters) or {"load": 1}
                found.append(change(f"t{index}", {**logged, **(where if draw(st.booleans()) else {})}, **more))
            case _:
                found.append(stop(f"t{index}", where if draw(st.booleans()) else {}, **more))
    return found


def applications(decisions: Any) -> dict[str, tuple[Any, ...]]:
    """The values of each demanded instance, and whether it is suspended."""
    return {
        name: (each.key, each.parameters, each.suspended, each.tasks)
        for name, each in decisions.items()
        if each.demanded
    }


def made(outcome: NamespaceOutcome, existing: list[ApplicationInstance]) -> list[ApplicationInstance]:
    """The instances after the manager has applied the decisions; none is released."""
    known = {each.name: each for each in existing}

    def one(decision: Decision) -> ApplicationInstance:
        return draft(("site", decision.name), decision, known.get(decision.name))

    return [one(each) for each in outcome.instances.values()]


@few
@given(tasks(), st.randoms())
def test_order_and_duplication_of_objects_do_not_matter(live: list[ApplicationTask], source: random.Random) -> None:
    shuffled = [*live, *source.sample(live, len(live) // 2)]
    source.shuffle(shuffled)
    assert of(*shuffled) == of(*live)


@few
@given(tasks(), tasks(), st.randoms())
def test_decisions_do_not_depend_on_the_managers_history(
    before: list[ApplicationTask], live: list[ApplicationTask], source: random.Random
) -> None:
    instances = made(of(*before), [])
    for count in sorted(source.sample(range(len(live) + 1), min(2, len(live) + 1))):
        instances = made(
            of(*live[:count], instances=instances), instances
        )  # it restarts in between, knowing nothing else
    outcome = of(*live, instances=instances)
    fresh = of(*live)
    assert applications(outcome.instances) == applications(fresh.instances)
    running = {each.name: each.spec for each in made(outcome, instances)}
    for each in made(fresh, []):
        assert running[each.name] == each.spec


@few
@given(tasks(), tasks())
def test_a_task_that_starts_and_ends_restores_the_former_state(
    live: list[ApplicationTask], others: list[ApplicationTask]
) -> None:
    extra = [each.model_copy(update={"metadata": each.metadata.model_copy(update={"name": f"x-{each.name}"})})
             for each in others]  # fmt: skip
    instances = made(of(*live), [])
    during = made(of(*live, *extra, instances=instances), instances)
    after = of(*live, instances=during)
    assert applications(after.instances) == applications(of(*live).instances)


@few
@given(tasks())
def test_every_task_has_a_result_and_only_deploy_starts_instances(
    live: list[ApplicationTask],
) -> None:
    outcome = of(*live)
    assert outcome.verdicts.keys() == {each.name for each in live}
    assert all(each.message for each in outcome.verdicts.values())
    serving = {name: each.name for each in outcome.instances.values() for name in each.tasks}
    for each in live:
        if each.spec.operation == "Deploy":
            verdict = outcome.verdicts[each.name]
            assert (verdict.kind is VerdictKind.COUNTS) == (each.name in serving)
            assert verdict.instance == serving.get(each.name)
    deployed = {each.spec.parameters["region"] for each in live if each.spec.operation == "Deploy"}
    assert {each.key for each in outcome.instances.values()} <= deployed
    for each in outcome.instances.values():
        highest = max(other.spec.priority for other in live if other.name in each.tasks)
        stopping = [
            other.spec.priority
            for other in live
            if other.spec.operation == "Suspend" and other.spec.parameters.get("region", each.key) == each.key
        ]
        assert each.suspended == any(priority >= highest for priority in stopping)
