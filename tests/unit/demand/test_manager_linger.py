"""Linger: an instance is released at its deadline, however late its status is written."""

from __future__ import annotations

from typing import Any

from application_manager.cache.cluster_cache import INSTANCE, ClusterCache
from application_manager.cache.store import Entry
from application_manager.core.demand.decisions import Decision
from application_manager.core.objects.policy import Policy
from tests.unit.manager_objects import NOW, instance, task, template
from wayside.api import ApplicationInstance, ApplicationTask
from wayside.api.base import API_VERSION

NAME = ("site", "app")


def cache_with(existing: ApplicationInstance) -> ClusterCache:
    cache = ClusterCache(Policy())
    see(cache, template(lifecycle={"linger": "30s"}), "1")
    see(cache, existing, "2")
    return cache


def see(cache: ClusterCache, model: Any, version: str) -> None:
    raw = {"apiVersion": API_VERSION, **model.to_json()}
    raw["metadata"] = {**raw["metadata"], "uid": model.metadata.uid or model.name, "resourceVersion": version}
    assert cache.store.put(raw) is not None


def claim(cache: ClusterCache, wanted: ApplicationTask) -> None:
    cache.claims.note(("site", wanted.name), Entry(wanted.to_json(), wanted), cache.template(NAME))


def decided(cache: ClusterCache, at: float) -> Decision:
    found, _ = cache.decide(NAME, NOW + at)
    cache.note(NAME, found)
    assert found.decision is not None
    return found.decision


def test_a_deadline_counts_from_its_decision_before_any_status_has_it() -> None:
    cache = cache_with(instance())
    assert decided(cache, 0).release_time == NOW + 30
    assert decided(cache, 20).release_time == NOW + 30
    assert decided(cache, 31).release_time == NOW + 30


def test_a_short_demand_restarts_the_linger_though_the_status_has_the_old_deadline() -> None:
    cache = cache_with(instance(release_at=NOW + 10))
    assert decided(cache, 0).release_time == NOW + 10
    claim(cache, task("a"))
    assert decided(cache, 5).release_time is None
    claim(cache, task("a", ended=True))
    assert decided(cache, 9).release_time == NOW + 9 + 30


def test_after_a_restart_the_deadline_of_the_status_counts() -> None:
    assert decided(cache_with(instance(release_at=NOW + 10)), 5).release_time == NOW + 10


def test_the_deadline_of_a_former_instance_of_the_same_name_is_ignored() -> None:
    cache = cache_with(instance())
    assert decided(cache, 0).release_time == NOW + 30
    successor = instance()
    successor = successor.model_copy(update={"metadata": successor.metadata.model_copy(update={"uid": "another"})})
    see(cache, successor, "3")
    assert cache.store.get(INSTANCE, NAME) is not None
    assert decided(cache, 20).release_time == NOW + 50


def test_the_deadline_of_a_deleted_instance_is_forgotten() -> None:
    cache = cache_with(instance(release_at=NOW + 10))
    decided(cache, 0)
    entry = cache.store.get(INSTANCE, NAME)
    assert entry is not None
    cache.store.remove(entry.raw)
    found, _ = cache.decide(NAME, NOW + 11)
    cache.note(NAME, found)
    assert found.decision is None
    assert cache.deadlines == {}
