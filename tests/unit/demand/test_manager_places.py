"""The manager's book of places says the same as the pure function of all that is live, whatever came in which order."""

from __future__ import annotations

from typing import Any, cast

from hypothesis import given, settings
from hypothesis import strategies as st

from application_manager.cache.cluster_cache import INSTANCE, TASK, TEMPLATE, ClusterCache
from application_manager.cluster.apply import Applier
from application_manager.cluster.client import Client
from application_manager.cluster.store import Name
from application_manager.core.claims.claims import instance_name
from application_manager.core.demand.demand import demand
from application_manager.core.objects.policy import Policy
from application_manager.watching.router import Router
from tests.unit.demand.test_limits import KEYED, limited
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate, Kind
from wayside.api.base import API_VERSION

TEMPLATES, REGIONS = ("app", "map"), "abc"

events = st.lists(
    st.one_of(
        st.tuples(st.just("task"), st.sampled_from(TEMPLATES), st.sampled_from(REGIONS), st.integers(0, 2)),
        st.tuples(st.just("end"), st.sampled_from(TEMPLATES), st.sampled_from(REGIONS), st.integers(0, 2)),
        st.tuples(st.just("make"), st.sampled_from(TEMPLATES), st.sampled_from(REGIONS), st.just(0)),
        st.tuples(st.just("delete"), st.sampled_from(TEMPLATES), st.sampled_from(REGIONS), st.just(0)),
        st.tuples(st.just("limit"), st.sampled_from(TEMPLATES), st.just(""), st.integers(0, 3)),
    ),
    max_size=25,
)


class Manager:
    """A cache and its router, without an API server."""

    def __init__(self, limit: int | None) -> None:
        self.cache = ClusterCache(Policy(), limit)
        self.asked: set[Name] = set()
        self.cache.places.changed = self.asked.add
        ask: Any = lambda _: None  # noqa: E731
        applier = Applier(cast("Client", None), self.cache.store, {})
        self.router = Router(self.cache, applier, self.asked.add, ask, ask, ask, ask)
        self.version = 0

    def sees(self, model: Kind) -> None:
        self.version += 1
        raw = {"apiVersion": API_VERSION, **model.to_json()}
        uid = raw["metadata"].get("uid") or f"uid-{raw['kind']}-{model.name}"
        raw["metadata"] = {**raw["metadata"], "uid": uid, "resourceVersion": str(self.version)}
        self.router.observe(raw)

    def misses(self, kind: tuple[str, str], name: str) -> None:
        entry = self.cache.store.get(kind, ("site", name))
        if entry is not None:
            self.router.vanished(entry.raw)

    def works(self) -> dict[str, tuple[bool, dict[str, Any]]]:
        """Decide all that was asked for, and what that asks for: the last word on each."""
        said: dict[str, tuple[bool, dict[str, Any]]] = {}
        while self.asked:
            name = self.asked.pop()
            decision = self.cache.decide(name, NOW)
            if decision is None:
                said[name[1]] = (False, {})
            else:
                verdicts = {each: (verdict.standing, verdict.reason) for each, verdict in decision.verdicts.items()}
                said[name[1]] = (decision.wanted, verdicts)
        return said


@settings(max_examples=60, deadline=None)
@given(events, st.none() | st.integers(1, 3))
def test_the_book_agrees_with_the_pure_function_after_each_event(history: Any, limit: int | None) -> None:
    manager, said = Manager(limit), {}
    for name in TEMPLATES:
        manager.sees(limited(None, name))
    for count, (what, of, region, number) in enumerate(history):
        name = instance_name(of, region)
        match what:
            case "task":
                made = task(f"{of}-{region}-{number}", {"region": region}, of=of, priority=number, created=count)
                manager.misses(TASK, made.name)
                uid = made.metadata.model_copy(update={"uid": f"uid-{count}"})
                manager.sees(made.model_copy(update={"metadata": uid}))
            case "end":
                manager.misses(TASK, f"{of}-{region}-{number}")
            case "make":
                made_instance = instance(name, of=of, key=region, parameters={"region": region})
                uid = made_instance.metadata.model_copy(update={"uid": f"uid-{count}"})
                manager.sees(made_instance.model_copy(update={"metadata": uid}))
            case "delete":
                manager.misses(INSTANCE, name)
            case _:
                manager.sees(template(of, **KEYED, **({"maxInstances": number} if number else {})))
        said |= manager.works()
        cache = manager.cache
        outcome = demand(
            cache.models(TEMPLATE, ApplicationTemplate, "site"),
            cache.models(TASK, ApplicationTask, "site"),
            cache.models(INSTANCE, ApplicationInstance, "site"),
            {},
            NOW,
            limit,
        )
        wanted = {each for each, decision in outcome.instances.items() if decision.wanted}
        assert {each for each, (runs, _) in said.items() if runs} == wanted
        verdicts: dict[str, Any] = {}
        for _, part in said.values():
            verdicts |= part
        assert verdicts == {each: (of_.standing, of_.reason) for each, of_ in outcome.verdicts.items()}


def test_what_is_being_made_has_its_place_already() -> None:
    manager = Manager(1)
    manager.sees(limited(1))
    manager.sees(task("a", {"region": "a"}))
    assert manager.works()[instance_name("app", "a")][0]
    manager.cache.places.being_made.add(("site", instance_name("app", "a")))
    manager.sees(task("b", {"region": "b"}, priority=9))
    said = manager.works()
    assert said[instance_name("app", "b")] == (False, {"b": ("Waiting", "LimitReached")})
    assert not said[instance_name("app", "a")][0]  # it is preempted before it is known to be there
