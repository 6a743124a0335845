"""The store holds the newest version of each object, in any order of events."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from application_manager.cache.store import Store

KIND = ("v1", "ConfigMap")
NAME = ("site", "x")


def raw(version: int, uid: str = "u", name: str = "x", namespace: str = "site") -> dict[str, Any]:
    metadata = {"name": name, "namespace": namespace, "uid": uid, "resourceVersion": str(version)}
    return {"apiVersion": "v1", "kind": "ConfigMap", "metadata": metadata}


@given(st.permutations([1, 2, 3, 4]))
def test_the_newest_version_wins_in_any_order(order: list[int]) -> None:
    store = Store([])
    for version in order:
        store.put(raw(version))
    entry = store.get(KIND, NAME)
    assert entry is not None
    assert entry.version == 4


def test_a_known_version_is_not_an_event() -> None:
    store = Store([])
    assert store.put(raw(1)) is not None
    assert store.put(raw(1)) is None


def test_a_deleted_object_does_not_return_from_an_old_list() -> None:
    store = Store([])
    store.put(raw(1))
    assert store.remove(raw(5)) is not None
    assert store.put(raw(3)) is None
    assert store.put(raw(7, uid="another")) is not None


def test_deleting_a_former_object_keeps_its_successor() -> None:
    store = Store([])
    store.put(raw(7, uid="successor"))
    assert store.remove(raw(8, uid="predecessor")) is None
    assert store.get(KIND, NAME) is not None


def test_a_list_removes_missing_objects_but_none_newer_than_itself() -> None:
    store = Store([])
    for each in (raw(1, "a", "gone"), raw(2, "b", "kept"), raw(9, "c", "newer"), raw(1, "d", "other", "elsewhere")):
        store.put(each)
    missing = store.missing(KIND, {("site", "kept")}, "5", "site")
    assert [entry.raw["metadata"]["name"] for entry in missing] == ["gone"]


def test_an_invalid_object_is_kept_with_the_reason() -> None:
    kind = ("wayside.dev/v1alpha1", "ApplicationTask")
    store = Store([kind])
    task = {**raw(1), "apiVersion": kind[0], "kind": kind[1], "spec": {"templateName": 7}}
    entry = store.put(task)
    assert entry is not None
    assert entry.model is None
    assert "spec.templateName" in entry.problem
