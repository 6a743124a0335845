"""The cache decides the same as the pure function of all that is live, whatever the order of events."""

from __future__ import annotations

from typing import Any, cast

from hypothesis import given, settings
from hypothesis import strategies as st

from application_manager.cache.cluster_cache import INSTANCE, TASK, TEMPLATE, ClusterCache
from application_manager.core.claims.claims import instance_name
from application_manager.core.demand.decisions import Decision
from application_manager.core.demand.demand import NamespaceOutcome, demand
from application_manager.core.objects.policy import Name, Policy
from application_manager.watching.router import Router
from application_manager.work.applying import Applier
from tests.unit.demand.test_limits import limited
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.api import ApplicationInstance, ApplicationTask, ApplicationTemplate, Kind
from wayside.api.base import API_VERSION
from wayside.kubernetes.client import Client
from wayside.times import format_seconds

TEMPLATES, REGIONS = ("app", "map"), "abc"
OPERATIONS = ("Deploy", "Deploy", "Reconfigure", "Suspend")
SPEC: dict[str, Any] = {
    "parameters": {"region": {"type": "string"}, "rate": {"type": "number", "default": 1, "merge": "Max"}},
    "key": "${parameters.region}",
}
LATE = {"type": "Ready", "status": "False", "reason": "NotReady", "lastTransitionTime": format_seconds(NOW - 900)}


def of(name: str, limit: int | None = None, *, falls_back: bool = False) -> ApplicationTemplate:
    """A template; the first may fall back to the second."""
    other = {"readyTimeout": "60s", "fallback": {"templateName": TEMPLATES[1]}} if falls_back else {}
    return template(name, **SPEC, lifecycle={"linger": "30s", **other}, **({"maxInstances": limit} if limit else {}))


def some(*of_each: Any) -> Any:
    return st.tuples(*(st.just(each) if isinstance(each, str) else each for each in of_each))


templates, regions, numbers = st.sampled_from(TEMPLATES), st.sampled_from(REGIONS), st.integers(0, 2)
events = st.lists(
    st.one_of(
        some("task", templates, regions, numbers, st.sampled_from(OPERATIONS)),
        some("to all", templates, regions, numbers, st.sampled_from(OPERATIONS[2:])),
        some("end", templates, regions, numbers, ""),
        some("make", templates, regions, numbers, ""),
        some("late", templates, regions, numbers, ""),
        some("delete", templates, regions, numbers, ""),
        some("template", templates, st.sampled_from(["", "falls back"]), st.integers(0, 3), ""),
    ),
    max_size=25,
)


class Manager:
    """A cache and its router, without an API server."""

    def __init__(self, limit: int | None) -> None:
        self.cache = ClusterCache(Policy(), limit)
        self.enqueued: set[Name] = set()
        ask: Any = lambda _: None  # noqa: E731
        applier = Applier(cast("Client", None), self.cache.store, {})
        self.router = Router(self.cache, applier, self.enqueued.add, ask, ask, ask, ask)
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
            self.router.deleted(entry.raw)

    def works(self) -> dict[str, Decision | None]:
        """Decide all that was enqueued, and what that enqueues: the last decision of each."""
        decided: dict[str, Decision | None] = {}
        while self.enqueued:
            name = self.enqueued.pop()
            found, others = self.cache.decide(name, NOW)
            assert self.cache.decide(name, NOW) == (found, others)  # it changes nothing
            self.cache.note(name, found)
            self.enqueued |= others
            decided[name[1]] = found.decision
        return decided

    def demand(self, limit: int | None) -> NamespaceOutcome:
        """The pure function of all that the cache has."""
        return demand(
            self.cache.models(TEMPLATE, ApplicationTemplate, "site"),
            self.cache.models(TASK, ApplicationTask, "site"),
            self.cache.models(INSTANCE, ApplicationInstance, "site"),
            {},
            NOW,
            limit,
        )


@settings(max_examples=300, deadline=None)
@given(events, st.none() | st.integers(1, 3))
def test_the_cache_agrees_with_the_pure_function_after_each_event(history: Any, limit: int | None) -> None:
    manager, decided = Manager(limit), dict[str, Decision | None]()
    for name in TEMPLATES:
        manager.sees(of(name, falls_back=name == TEMPLATES[0]))
    for count, (what, template_, region, number, operation) in enumerate(history):
        name = instance_name(template_, region)
        made: Kind
        match what:
            case "task" | "to all":
                given_ = {"region": region} if what == "task" else {}
                given_ |= {"rate": number + 2} if number else {}
                called = f"{template_}-{region}-{number}"
                made = task(called, given_, of=template_, priority=number, created=count, operation=operation)
                manager.misses(TASK, made.name)
                manager.sees(numbered(made, count))
            case "end":
                manager.misses(TASK, f"{template_}-{region}-{number}")
            case "make" | "late":
                made = instance(name, of=template_, key=region, parameters={"region": region}, suspended=number == 2)
                manager.sees(numbered(made, count, {"conditions": [LATE]} if what == "late" else None))
            case "delete":
                manager.misses(INSTANCE, name)
            case _:
                manager.sees(of(template_, number, falls_back=bool(region) and template_ == TEMPLATES[0]))
        decided |= manager.works()
        outcome = manager.demand(limit)
        own = {each: decision for each, decision in decided.items() if decision is not None and "*" not in each}
        assert own == outcome.instances | outcome.waiting


def numbered(made: Kind, number: int, status: dict[str, Any] | None = None) -> Kind:
    """The object with a uid of its own, and a status."""
    raw = made.to_json()
    raw["metadata"]["uid"] = f"uid-{number}"
    return type(made).model_validate({**raw, **({"status": status} if status else {})})


def test_an_instance_being_created_already_has_its_place() -> None:
    manager = Manager(1)
    manager.sees(limited(1))
    manager.sees(task("a", {"region": "a"}))
    first = manager.works()[instance_name("app", "a")]
    assert first is not None
    assert first.demanded
    manager.cache.places.being_created.add(("site", instance_name("app", "a")))
    manager.sees(task("b", {"region": "b"}, priority=9))
    decided = manager.works()
    first, other = decided[instance_name("app", "a")], decided[instance_name("app", "b")]
    assert other is not None
    assert not other.demanded
    assert (other.verdicts["b"].kind, other.verdicts["b"].reason) == ("Waiting", "LimitReached")
    assert first is not None
    assert not first.demanded
