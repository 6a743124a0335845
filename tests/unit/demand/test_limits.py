"""Limits select the running instances as a pure function of the live tasks, and are never exceeded."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from application_manager.core.claims.claims import instance_name
from application_manager.core.claims.operations import VerdictKind
from application_manager.core.demand.demand import NamespaceOutcome, demand
from application_manager.core.demand.drafting import draft
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.api import ApplicationInstance, ApplicationTask
from wayside.times import format_seconds

KEYED: dict[str, Any] = {"parameters": {"region": {"type": "string", "required": True}}, "key": "${parameters.region}"}


def limited(count: int | None, name: str = "app", **lifecycle: Any) -> Any:
    spec = {**KEYED, "lifecycle": {"linger": "30s", **lifecycle}}
    return template(name, **(spec if count is None else {**spec, "maxInstances": count}))


def wants(region: str, **more: Any) -> ApplicationTask:
    """A task with the region's name, unless `name` is given."""
    return task(more.pop("name", region), {"region": region}, **more)


def runs(region: str, *, of: str = "app", created: float = NOW - 1000, **more: Any) -> ApplicationInstance:
    made = instance(instance_name(of, region), of=of, key=region, parameters={"region": region}, **more)
    return since(made, created)


def since(made: ApplicationInstance, created: float) -> ApplicationInstance:
    metadata = made.metadata.model_copy(update={"creation_timestamp": format_seconds(created)})
    return made.model_copy(update={"metadata": metadata})


def served(live: ApplicationTask) -> ApplicationTask:
    """The task once its status reports that its instance was applied."""
    raw = live.to_json()
    condition = {"type": "Applied", "status": "True", "reason": "Applied", "lastTransitionTime": format_seconds(NOW)}
    raw["status"] = {"conditions": [condition]}
    return ApplicationTask.model_validate(raw)


def of(*tasks: ApplicationTask, limit: int | None = 1, **others: Any) -> NamespaceOutcome:
    templates = others.pop("templates", None) or [limited(limit)]
    instances, now = others.pop("instances", []), others.pop("now", NOW)
    return demand(templates, tasks, instances, {}, now, others.pop("total", None))


def running(outcome: NamespaceOutcome) -> set[str]:
    """The keys of the instances that may run."""
    return {str(each.key) for each in outcome.instances.values() if each.demanded}


def going(outcome: NamespaceOutcome) -> set[str]:
    """The keys of the instances to release now."""
    ends = {each.key: each.release_time for each in outcome.instances.values()}
    return {str(key) for key, end in ends.items() if end is not None and end <= NOW}


# --- Who has a place


def test_without_a_limit_everything_runs() -> None:
    assert running(of(wants("a"), wants("b"), wants("c"), limit=None)) == {"a", "b", "c"}


def test_of_equal_priority_the_older_runs_and_the_other_waits_visibly() -> None:
    outcome = of(wants("b", created=1), wants("a", created=2))
    assert running(outcome) == {"b"}
    verdict = outcome.verdicts["a"]
    assert (verdict.kind, verdict.reason, verdict.instance) == (VerdictKind.WAITING, "LimitReached", None)
    for part in ("template app is at its limit of 1 instance (spec.maxInstances)", "a priority of 1 or more"):
        assert part in verdict.message


def test_a_higher_priority_preempts_and_both_tasks_name_the_other() -> None:
    low, high = wants("low"), wants("high", priority=5, created=1)
    outcome = of(low, high, instances=[runs("low")])
    assert (running(outcome), going(outcome)) == (set(), {"low"})  # the limit holds also in between
    assert outcome.verdicts["low"].reason == "Preempted"
    assert "task high, priority 5" in outcome.verdicts["low"].message
    assert "is deleted, and preempts" in outcome.verdicts["high"].message
    assert "task low" in outcome.verdicts["high"].message
    after = of(served(low), high)
    assert running(after) == {"high"}
    assert after.verdicts["low"].reason == "Preempted"
    assert f"was preempted by instance {instance_name('app', 'high')} (task high" in after.verdicts["low"].message
    assert f"preempts instance {instance_name('app', 'low')} (task low" in after.verdicts["high"].message
    assert (
        running(of(served(low), instances=[runs("high", release_at=NOW + 9)])) == set()
    )  # until the lingering instances are deleted
    assert running(of(served(low))) == {"low"}


def test_an_instance_that_never_ran_does_not_report_preemption() -> None:
    assert of(wants("low"), wants("high", priority=5, created=1)).verdicts["low"].reason == "LimitReached"


def test_an_older_task_of_equal_priority_never_preempts() -> None:
    outcome = of(wants("old"), wants("new", created=9), instances=[runs("new")])
    assert (running(outcome), going(outcome)) == ({"new"}, set())


def test_lingering_instances_yield_first_in_order_of_their_deadlines() -> None:
    lingering = [runs("a", release_at=NOW + 20), runs("b", release_at=NOW + 10)]
    first = of(wants("c"), instances=lingering, limit=2)
    assert (running(first), going(first)) == (set(), {"b"})
    assert running(of(wants("c"), instances=lingering[:1], limit=2)) == {"c"}
    assert going(of(wants("b"), instances=[*lingering], limit=2)) == set()


def test_an_instance_being_deleted_keeps_its_place_until_it_is_gone() -> None:
    there = runs("a")
    metadata = there.metadata.model_copy(update={"deletion_timestamp": format_seconds(NOW)})
    outcome = of(wants("b"), instances=[there.model_copy(update={"metadata": metadata})])
    assert running(outcome) == set()
    assert f"starts once {there.name} is deleted" in outcome.verdicts["b"].message


def test_lowering_the_limit_stops_the_last_in_order() -> None:
    tasks = [wants("a"), wants("b", created=1), wants("c", created=2)]
    outcome = of(*tasks, instances=[runs(each) for each in "abc"], limit=2)
    assert (running(outcome), going(outcome)) == ({"a", "b"}, {"c"})
    assert outcome.verdicts["c"].reason == "LimitReached"


def test_the_namespace_limit_covers_all_templates_and_baselines_rank_last() -> None:
    always = template("always", baseline={"parameters": {}})
    templates = [limited(None), limited(None, "map"), always]
    tasks = [wants("a"), wants("b", of="map", created=1), wants("c", of="map", created=2)]
    outcome = of(*tasks, templates=templates, total=2)
    assert running(outcome) == {"a", "b"}
    assert "the namespace is at its limit of 2 instances (--max-instances" in outcome.verdicts["c"].message
    assert "always" in of(*tasks, templates=templates, total=4).instances


def test_both_limits_hold_at_once() -> None:
    templates = [limited(1), limited(None, "map")]
    tasks = [wants("a"), wants("b", created=1), wants("x", of="map", created=2), wants("y", of="map", created=3)]
    assert running(of(*tasks, templates=templates, total=2)) == {"a", "x"}
    assert running(of(*tasks, templates=templates, total=3)) == {"a", "x", "y"}


@pytest.mark.parametrize("annotation", ["wayside.dev/pause", "wayside.dev/hold"])
def test_a_manually_held_instance_is_not_preempted_and_counts(annotation: str) -> None:
    kept = runs("low", annotations={annotation: "anna"})
    outcome = of(wants("low"), wants("high", priority=5), instances=[kept])
    assert (running(outcome), going(outcome)) == ({"low"}, set())


def test_a_manually_created_instance_takes_no_place() -> None:
    assert running(of(wants("a"), instances=[runs("mine", by_person=True)])) == {"a"}


def test_tasks_that_act_on_an_instance_without_a_place_wait_too() -> None:
    tasks = [wants("a"), wants("b", created=1), task("stop", {"region": "b"}, operation="Suspend")]
    verdict = of(*tasks).verdicts["stop"]
    assert (verdict.kind, verdict.reason) == (VerdictKind.WAITING, "NothingRuns")
    assert "does not run" in verdict.message


# --- minUptime


def test_nothing_is_preempted_before_its_min_uptime_and_then_it_is() -> None:
    templates = [limited(1, minUptime="60s")]
    tasks = [wants("low"), wants("high", priority=5)]
    young = [runs("low", created=NOW - 59)]
    outcome = of(*tasks, templates=templates, instances=young)
    assert running(outcome) == {"low"}
    assert outcome.next_change == NOW + 1
    assert f"after {format_seconds(NOW + 1)}, when the minUptime of another" in outcome.verdicts["high"].message
    later = of(*tasks, templates=templates, instances=young, now=NOW + 1)
    assert going(later) == set()
    assert later.verdicts["low"].reason == "Preempted"


def test_nothing_is_released_before_its_min_uptime() -> None:
    templates = [limited(None, minUptime="60s", linger="5s")]
    (decision,) = of(templates=templates, instances=[runs("a", created=NOW - 10)]).instances.values()
    assert decision.release_time == NOW + 50
    (decision,) = of(templates=templates, instances=[runs("a", created=NOW - 58)]).instances.values()
    assert decision.release_time == NOW + 5


# --- Laws

REGIONS, NAMES = "abcdef", ("app", "map")
few = settings(max_examples=60, deadline=None)

demands = st.lists(
    st.tuples(st.sampled_from(NAMES), st.sampled_from(REGIONS), st.integers(0, 2), st.integers(0, 3)), max_size=9
)
limits = st.tuples(st.none() | st.integers(1, 3), st.none() | st.integers(1, 3), st.none() | st.integers(1, 4))


def tasks_of(drawn: Iterable[tuple[str, str, int, int]], prefix: str = "t") -> list[ApplicationTask]:
    return [
        wants(region, name=f"{prefix}{index}", of=of_, priority=priority, created=created)
        for index, (of_, region, priority, created) in enumerate(drawn)
    ]


class SimulatedNamespace:
    """A namespace under a simulated manager, step by step; its only state is the live objects."""

    def __init__(self, bounds: tuple[int | None, int | None, int | None], uptime: int = 0) -> None:
        self.own = dict(zip(NAMES, bounds, strict=False))
        self.total = bounds[2]
        self.templates = [limited(count, name, minUptime=f"{uptime}s", linger="3s") for name, count in self.own.items()]
        self.instances: dict[str, ApplicationInstance] = {}
        self.now = NOW

    def outcome(self, live: list[ApplicationTask]) -> NamespaceOutcome:
        return demand(self.templates, live, self.instances.values(), {}, self.now, self.total)

    def step(self, live: list[ApplicationTask], source: random.Random | None = None) -> bool:
        """Apply some or all decisions in any order; return whether there was anything to do."""
        decided = list(self.outcome(live).instances.values())
        todo = [each for each in decided if self._is_due(each)]
        acted = todo if source is None else source.sample(todo, source.randint(0, len(todo)))
        for each in acted:
            if each.demanded:
                made = since(draft(("site", each.name), each, None), self.now)
                labels = {"app.kubernetes.io/managed-by": "wayside"}
                metadata = made.metadata.model_copy(update={"labels": labels})
                self.instances[each.name] = made.model_copy(update={"metadata": metadata})
            else:
                del self.instances[each.name]
        for each in decided:  # the status has the release time of lingering instances
            if each.name in self.instances and not each.demanded and each.release_time is not None:
                raw = self.instances[each.name].to_json()
                raw["status"] = {"releaseTime": format_seconds(each.release_time)}
                self.instances[each.name] = ApplicationInstance.model_validate(raw)
            elif each.name in self.instances:
                self.instances[each.name] = self.instances[each.name].model_copy(update={"status": None})
        return bool(todo)

    def _is_due(self, each: Any) -> bool:
        if each.name not in self.instances:
            return bool(each.demanded)
        return not each.demanded and each.release_time is not None and each.release_time <= self.now

    def settle(self, live: list[ApplicationTask], *, linger: bool = True) -> None:
        for _ in range(50):
            if not self.step(live):
                if not linger or not any(each.status for each in self.instances.values()):
                    return
                self.now += 5
        raise AssertionError("it never becomes stable")

    def check_limits(self) -> None:
        counts = Counter(each.spec.template_name for each in self.instances.values())
        for name, count in self.own.items():
            assert count is None or counts[name] <= count
        assert self.total is None or counts.total() <= self.total


@few
@given(demands, demands, limits, st.randoms())
def test_order_and_duplication_of_objects_do_not_matter(before: Any, drawn: Any, bounds: Any, source: Any) -> None:
    site, live = SimulatedNamespace(bounds), tasks_of(drawn)
    site.settle(tasks_of(before, "b"), linger=False)
    expected = site.outcome(live)
    shuffled = [*live, *source.sample(live, len(live) // 2)]
    source.shuffle(shuffled)
    source.shuffle(site.templates)
    site.instances = dict(source.sample(sorted(site.instances.items()), len(site.instances)))
    assert site.outcome(shuffled) == expected


@few
@given(st.lists(demands, min_size=1, max_size=4), limits, st.sampled_from([0, 4]), st.randoms())
def test_no_limit_is_ever_exceeded_in_any_order_of_steps(history: Any, bounds: Any, uptime: int, source: Any) -> None:
    site = SimulatedNamespace(bounds, uptime)
    for index, drawn in enumerate(history):
        live = tasks_of(drawn, f"h{index}-")
        for _ in range(4):
            site.step(live, source)
            site.check_limits()
            site.now += source.choice([0, 1, 3])


@few
@given(demands, demands, limits)
def test_a_higher_priority_never_waits_while_a_lower_one_runs(before: Any, drawn: Any, bounds: Any) -> None:
    site, live = SimulatedNamespace(bounds), tasks_of(drawn)
    site.settle(tasks_of(before, "b"))
    site.settle(live)
    site.check_limits()
    highest: dict[tuple[str, str], int] = {}
    for each in live:
        name = (each.spec.template_name, instance_name(each.spec.template_name, str(each.spec.parameters["region"])))
        highest[name] = max(each.spec.priority, highest.get(name, each.spec.priority))
    counts = Counter(each.spec.template_name for each in site.instances.values())
    for (own, name), priority in highest.items():
        if name in site.instances:
            continue
        own_full = site.own[own] is not None and counts[own] >= (site.own[own] or 0)
        all_full = site.total is not None and counts.total() >= site.total
        assert own_full or all_full  # a place is never left empty
        same = [of_priority for (of_, each), of_priority in highest.items() if each in site.instances and of_ == own]
        everybody = [of_priority for (_, each), of_priority in highest.items() if each in site.instances]
        assert all(each >= priority for each in (same if own_full else everybody))


@few
@given(demands, demands, limits)
def test_decisions_converge_and_an_ended_demand_restores_the_former_state(drawn: Any, more: Any, bounds: Any) -> None:
    site, live = SimulatedNamespace(bounds), tasks_of(drawn)
    site.settle(live)
    before = set(site.instances)
    known = {(each.spec.template_name, each.spec.parameters["region"]) for each in live}
    later = [(own, region, priority, 3600) for own, region, priority, _ in more if (own, region) not in known]
    extra = tasks_of(later, "x")  # they want applications of their own
    site.settle([*live, *extra])
    assert not site.step([*live, *extra])
    site.settle(live)
    assert set(site.instances) == before


@few
@given(demands, limits, st.integers(0, 40))
def test_with_no_instances_the_first_in_order_run(drawn: Any, bounds: Any, seconds: int) -> None:
    """The order by hand: one after the other, as far as there is room; and time alone changes nothing."""
    site, live = SimulatedNamespace(bounds), tasks_of(drawn)
    expected: dict[str, str] = {}
    ordered = sorted(live, key=lambda each: (-each.spec.priority, each.metadata.creation_timestamp, each.name))
    for each in ordered:
        own = each.spec.template_name
        name = instance_name(own, str(each.spec.parameters["region"]))
        counts = Counter(expected.values())
        full = counts[own] >= (site.own[own] or 99) or counts.total() >= (site.total or 99)
        if name not in expected and not full:
            expected[name] = own
    site.settle(live)
    assert set(site.instances) == set(expected)
    site.now += seconds
    assert not site.step(live)
