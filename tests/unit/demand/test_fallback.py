"""A demand moves to the fallback template if its instance is not ready in time, and returns once it stays ready."""

from __future__ import annotations

import random
from functools import cache
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from application_manager.core.claims.claims import instance_name
from application_manager.core.claims.operations import VerdictKind
from application_manager.core.demand.demand import NamespaceOutcome, demand
from application_manager.core.demand.fallback import fallback_conditions, overdue
from application_manager.core.holders.leases import LeaseView
from tests.unit.demand.test_manager_places import Manager
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.api import ApplicationInstance, ApplicationTask
from wayside.api.applicationinstance import ApplicationInstanceStatus
from wayside.api.base import Condition
from wayside.times import format_seconds

FULL: dict[str, Any] = {
    "parameters": {
        "region": {"type": "string", "required": True},
        "sources": {"type": "array", "items": "string", "merge": "Union"},
    },
    "key": "${parameters.region}",
    "lifecycle": {"readyTimeout": "60s", "fallback": {"templateName": "lite"}},
}
LITE: dict[str, Any] = {"parameters": {"region": {"type": "string", "required": True}}, "key": "${parameters.region}"}
NORTH, LITE_NORTH = instance_name("app", "north"), instance_name("lite", "north")


def conditions(**since: tuple[str, float]) -> list[dict[str, Any]]:
    """By type, its status and how many seconds ago it came to it."""
    return [
        {"type": type_, "status": status, "reason": "R", "lastTransitionTime": format_seconds(NOW - ago)}
        for type_, (status, ago) in since.items()
    ]


def runs(of: str = "app", region: str = "north", suspended: bool = False, **since: Any) -> ApplicationInstance:
    made = instance(
        instance_name(of, region), of=of, key=region, parameters={"region": region}, suspended=suspended
    ).to_json()
    made["metadata"]["creationTimestamp"] = format_seconds(NOW - 9000)
    made["status"] = {"conditions": conditions(**since)}
    return ApplicationInstance.model_validate(made)


def late(region: str = "north") -> ApplicationInstance:
    return runs(region=region, Ready=("False", 100), TimedOut=("True", 40))


def wants(name: str = "a", region: str = "north", **more: Any) -> ApplicationTask:
    return task(name, {"region": region, **more.pop("parameters", {})}, **more)


def of(*tasks: ApplicationTask, **more: Any) -> NamespaceOutcome:
    templates = more.pop("templates", None) or [template(**FULL), template("lite", **LITE)]
    return demand(
        templates, tasks, more.pop("instances", [late()]), more.pop("leases", {}), NOW, more.pop("limit", None)
    )


# --- When it is overdue


@pytest.mark.parametrize(
    ("since", "beyond", "change"),
    [
        ({}, True, None),  # it has no condition yet: since its creation
        ({"Ready": ("Unknown", 0)}, True, None),  # as the API server creates it
        ({"Ready": ("False", 59)}, False, NOW + 1),
        ({"Ready": ("False", 60)}, True, None),
        ({"Ready": ("True", 9999)}, False, None),
        ({"Ready": ("False", 500), "TimedOut": ("True", 440)}, True, None),
        ({"Ready": ("True", 59), "TimedOut": ("True", 440)}, True, NOW + 1),
        ({"Ready": ("True", 60), "TimedOut": ("True", 440)}, False, None),
        ({"Ready": ("False", 500), "TimedOut": ("False", 400)}, True, None),
        ({"Ready": ("False", 500), "Suspended": ("False", 10)}, False, NOW + 50),
    ],
)
def test_an_instance_is_overdue_after_not_ready_for_the_timeout_and_recovers_after_ready_as_long(
    since: Any, beyond: bool, change: float | None
) -> None:
    assert overdue(runs(**since), template(**FULL), NOW) == ("60s" if beyond else "", change)


def test_suspended_instances_and_those_without_a_timeout_are_never_overdue() -> None:
    assert overdue(runs(Ready=("False", 500), suspended=True), template(**FULL), NOW) == ("", None)
    assert overdue(runs(Ready=("False", 500)), template("lite", **LITE), NOW) == ("", None)


def test_a_rejected_update_makes_no_running_instance_overdue() -> None:
    app = runs(Ready=("False", 500), Applied=("False", 500))
    assert overdue(app, template(**FULL), NOW)[0] == "60s"
    assert app.status is not None
    once = app.model_copy(update={"status": app.status.model_copy(update={"spec_hash": "digest"})})
    assert overdue(once, template(**FULL), NOW) == ("", None)


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 100)), min_size=1, max_size=12))
def test_the_state_changes_only_after_a_full_timeout_in_the_other_one(series: list[tuple[bool, int]]) -> None:
    """Each pair is whether the app is ready, and for how many seconds; a new manager looks each second."""
    of, app, status = template(**FULL), runs(), ApplicationInstanceStatus()
    now, ready_since, previous = NOW, NOW, False
    timed_out: list[Condition] = []
    logged = []
    for is_ready, seconds in series:
        if is_ready != previous:
            previous, ready_since = is_ready, now
        ready = condition("Ready", is_ready, ready_since)
        for _ in range(seconds):
            seen = status.model_copy(update={"conditions": [ready, *timed_out]})
            beyond = bool(overdue(app.model_copy(update={"status": seen}), of, now)[0])
            logged.append((beyond, is_ready, now - ready_since))
            if beyond or timed_out:
                timed_out = [condition("TimedOut", beyond, NOW)]
            now += 1
    for (before, _, _), (after, is_ready, lasts) in pairwise(logged):
        if before != after:
            assert lasts >= 60
            assert is_ready == before  # it recovers while it is ready, and is overdue while it is not


@cache
def condition(type_: str, holds: bool, since: float) -> Condition:
    return Condition(type=type_, status=str(holds), reason="R", last_transition_time=format_seconds(since))


# --- What the demand turns to


def test_the_fallback_serves_with_its_known_parameters_and_the_primary_keeps_trying() -> None:
    outcome = of(wants(parameters={"sources": ["car1"]}), wants("b"))
    assert (outcome.instances[NORTH].demanded, outcome.instances[LITE_NORTH].tasks) == (True, ("a", "b"))
    assert outcome.instances[LITE_NORTH].parameters == {"region": "north"}
    assert outcome.instances[LITE_NORTH].template == "lite"
    verdict = outcome.verdicts["a"]
    assert (verdict.kind, verdict.reason, verdict.instance) == (VerdictKind.COUNTS, "FallenBack", LITE_NORTH)
    assert verdict.message == (
        f"instance {NORTH} is not ready; until it is, instance {LITE_NORTH} of template lite serves the task"
    )


def test_both_instances_report_the_fallback() -> None:
    outcome = of(wants())
    first, other = outcome.instances[NORTH], outcome.instances[LITE_NORTH]
    (timed_out,) = fallback_conditions([], first.overdue, first.fallback, first.stands_in_for)
    assert (timed_out.type, timed_out.holds, timed_out.reason) == ("TimedOut", True, "ReadyTimeout")
    assert f"template lite ({LITE_NORTH}) serves its tasks until this instance has been ready" in timed_out.message
    (stands_in,) = fallback_conditions([], other.overdue, other.fallback, other.stands_in_for)
    assert (stands_in.type, stands_in.holds) == ("StandsIn", True)
    assert NORTH in stands_in.message


def test_the_demand_returns_to_the_primary_and_the_fallback_lingers() -> None:
    back = runs(Ready=("True", 60), TimedOut=("True", 400))
    outcome = of(wants(), instances=[back, runs("lite", Ready=("True", 300))])
    assert (outcome.verdicts["a"].reason, outcome.verdicts["a"].instance) == ("Accepted", NORTH)
    assert outcome.instances[LITE_NORTH].release_time == NOW + 30
    soon = runs(Ready=("True", 59), TimedOut=("True", 400))
    assert of(wants(), instances=[soon]).verdicts["a"].instance == LITE_NORTH


def test_tasks_of_the_fallback_template_and_redirected_tasks_share_its_instance() -> None:
    outcome = of(wants(), task("own", {"region": "north"}, of="lite", priority=1))
    assert outcome.instances[LITE_NORTH].tasks == ("own", "a")
    assert outcome.verdicts["own"].reason == "Accepted"


@pytest.mark.parametrize(
    ("other", "shows"),
    [
        ([], "there is no ApplicationTemplate 'lite': create it"),
        (
            [template("lite", parameters={"site": {"type": "string", "required": True}})],
            "spec.parameters.site: is missing",
        ),
        ([template("lite", parameters={"region": {"type": "string", "enum": ["south"]}})], "spec.parameters.region"),
    ],
)
def test_a_task_stays_with_its_template_and_reports_why_the_fallback_cannot_serve(other: Any, shows: str) -> None:
    verdict = of(wants(), templates=[template(**FULL), *other]).verdicts["a"]
    assert (verdict.kind, verdict.reason, verdict.instance) == (VerdictKind.COUNTS, "FallbackFailed", NORTH)
    assert shows in verdict.message


def test_no_fallback_without_demand_or_while_suspended_or_with_a_lost_holder() -> None:
    assert LITE_NORTH not in of().instances
    assert LITE_NORTH not in of(wants(), task("s", {"region": "north"}, operation="Suspend")).instances
    lost = of(wants(holder="det"), leases={"det": LeaseView(1000, 15)})
    assert LITE_NORTH not in lost.instances


def test_a_fallback_waits_for_a_place_like_all_others() -> None:
    verdict = of(wants(), limit=1).verdicts["a"]
    assert (verdict.reason, verdict.instance) == ("FallbackFailed", NORTH)
    assert "the namespace is at its limit" in verdict.message


def test_templates_that_fall_back_to_each_other_do_not_forward_redirected_tasks() -> None:
    lite = {**LITE, "lifecycle": {"readyTimeout": "60s", "fallback": {"templateName": "app"}}}
    templates = [template(**FULL), template("lite", **lite)]
    other = runs("lite", Ready=("False", 100), TimedOut=("True", 40))
    outcome = of(wants(), task("b", {"region": "north"}, of="lite"), templates=templates, instances=[late(), other])
    assert outcome.instances[NORTH].tasks == ("a", "b")
    assert outcome.instances[LITE_NORTH].tasks == ("a", "b")
    assert outcome.verdicts["a"].instance == LITE_NORTH
    assert outcome.verdicts["b"].instance == NORTH


def test_a_fallback_without_a_timeout_is_refused() -> None:
    with pytest.raises(ValidationError, match="fallback needs readyTimeout"):
        template(**{**FULL, "lifecycle": {"fallback": {"templateName": "lite"}}})


# --- Laws

drawn = st.lists(
    st.tuples(st.sampled_from("xyz"), st.integers(0, 2), st.sampled_from(["app", "app", "lite"])), max_size=6
)
few = settings(max_examples=50, deadline=None)


def demands(which: Any) -> list[ApplicationTask]:
    return [
        task(f"t{index}", {"region": region}, of=of_, priority=priority)
        for index, (region, priority, of_) in enumerate(which)
    ]


@few
@given(drawn, st.sets(st.sampled_from("xyz")), st.none() | st.integers(1, 4), st.randoms())
def test_order_and_duplication_of_objects_do_not_matter(
    which: Any, slow: set[str], limit: int | None, source: random.Random
) -> None:
    live, existing = demands(which), [late(each) for each in sorted(slow)]
    expected = of(*live, instances=existing, limit=limit)
    shuffled = [*live, *source.sample(live, len(live) // 2)]
    source.shuffle(shuffled)
    source.shuffle(existing)
    assert of(*shuffled, instances=existing, limit=limit) == expected


@few
@given(drawn, st.sets(st.sampled_from("xyz")), st.none() | st.integers(1, 4), st.randoms())
def test_the_managers_decisions_do_not_depend_on_the_order_of_events(
    which: Any, slow: set[str], limit: int | None, source: random.Random
) -> None:
    live, existing = demands(which), [late(each) for each in sorted(slow)]
    manager = Manager(limit)
    everything: list[Any] = [*live, *existing]
    source.shuffle(everything)
    templates = [template(**FULL), template("lite", **LITE)]
    source.shuffle(templates)
    for each in [*templates[:1], *everything[:3], *templates[1:], *everything[3:]]:
        manager.sees(each)
    decided = manager.works()
    expected = of(*live, instances=existing, limit=limit)
    wanted = {name for name, each in expected.instances.items() if each.demanded}
    assert {name for name, each in decided.items() if each is not None and each.demanded} == wanted
