"""The tasks at the API server match the demands after outages, restarts and manual changes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from detector.actions.deploy.kubernetes_store import KubernetesTaskStore
from detector.actions.deploy.reconciler import DemandReconciler, DeployCounts
from detector.actions.deploy.stores import TaskExistsError, restore, task_manifest
from detector.engine.episodes.demands import Demand, to_task
from detector.engine.episodes.record import EpisodeRecord
from tests.cluster.api import Api, Object, Objects
from tests.cluster.background import Background, background
from tests.cluster.controlplane import ControlPlane
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE

SECOND = 10**9
START = 1_767_225_600 * SECOND + 123_456_789
HOLDER = "intersection-a"
RARELY = 600.0  # s between two resyncs: tests see only the events of the watch


def demand(namespace: str, subject: str = "car1+car2", **changes: Any) -> Demand:
    made = Demand(
        EpisodeRecord(
            id=f"episode-{subject}",
            rule="lidar-vehicles-close",
            subject=subject,
            clients=tuple(subject.split("+")),
            element=None,
            onset_time=START - 2 * SECOND,
            start_time=START,
            values={},
            classification={"overarchingPurpose": ["Safety"]},
            rule_digest="0123456789abcdef",
        ),
        action="record",
        template="scene-recorder",
        priority=0,
        parameters={"vehicles": subject.split("+"), "rateHz": 10.0, "grid": {"cells": [1.5, None], "frame": "map"}},
        detector="intersection-a",
        holder=HOLDER,
        namespace=namespace,
    )
    return dataclasses.replace(made, **changes)


def by_name(*demands: Demand) -> dict[str, Demand]:
    return {each.name: each for each in demands}


class BackgroundReconciler:
    """A reconciler that runs in the background."""

    def __init__(self, loop: Background, namespace: str, holder: str, resync: float):
        self._loop = loop
        self.store = KubernetesTaskStore(loop.api, namespace, holder, resync)
        self.reconciler = loop.call(self._make())
        self._future = loop.start(self.reconciler.run())

    async def _make(self) -> DemandReconciler:
        return DemandReconciler(self.store)

    @property
    def counts(self) -> DeployCounts:
        return self.reconciler.counts

    def update(self, demands: Mapping[str, Demand], ended: Mapping[str, int] | None = None) -> None:
        self.reconciler.update(demands, ended or {})

    def restored(self) -> list[Demand]:
        return self._loop.call(restore(self.store))

    def counted(self, expected: DeployCounts) -> None:
        """Wait for these counts: a change is counted only once the API server has reported it."""
        wait_until(lambda: self.counts, expected.__eq__, what=f"counted: {expected}")

    def stop(self, deadline: float = 60.0) -> None:
        self._loop.loop.call_soon_threadsafe(self.reconciler.stop, deadline)
        self._future.result(PATIENCE)


@contextmanager
def reconciling(
    kubeconfig: Path, namespace: str, holder: str = HOLDER, resync: float = RARELY
) -> Iterator[BackgroundReconciler]:
    with background(kubeconfig) as loop:
        running = BackgroundReconciler(loop, namespace, holder, resync)
        yield running
        running.stop()


@pytest.fixture
def running(control_plane: ControlPlane, namespace: str) -> Iterator[BackgroundReconciler]:
    with reconciling(control_plane.kubeconfig, namespace) as started:
        yield started


def tasks_are(api: Api, live: set[str], ended: set[str] | None = None) -> Objects:
    def holds(found: Objects) -> bool:
        names = {
            is_live: {each["metadata"]["name"] for each in found if is_ended(each) != is_live}
            for is_live in (True, False)
        }
        return names[True] == live and names[False] == (ended or set())

    return api.wait_list("ApplicationTask", holds, what=f"live tasks {live}, ended tasks {ended or set()}")


def is_ended(task: Object) -> bool:
    return "endTime" in task["spec"]


def test_a_demand_becomes_a_task_that_ends_with_the_demand(
    api: Api, namespace: str, running: BackgroundReconciler
) -> None:
    wanted = demand(namespace)
    running.update(by_name(wanted))
    [task] = tasks_are(api, {wanted.name})
    assert task["spec"] == task_manifest(to_task(wanted))["spec"]
    assert task["metadata"]["labels"] == {"wayside.dev/holder": HOLDER}
    assert running.restored() == [wanted]

    running.update({}, {wanted.name: START + 7 * SECOND + 1})
    [task] = tasks_are(api, set(), {wanted.name})
    assert task["spec"]["endTime"] == "2026-01-01T00:00:07.123456790Z"
    assert running.restored() == []
    running.counted(DeployCounts(created=1, ended=1))


def test_the_values_at_the_start_are_kept(api: Api, namespace: str, running: BackgroundReconciler) -> None:
    wanted = demand(namespace)
    values = {"distance": 149.5, "a": {"client": "car1", "streams": ["pose"]}}
    wanted = dataclasses.replace(wanted, episode=msgspec.structs.replace(wanted.episode, values=values))
    running.update(by_name(wanted))
    tasks_are(api, {wanted.name})
    assert running.restored() == [wanted]


def test_changed_parameters_are_patched_and_removed_ones_are_deleted(
    api: Api, namespace: str, running: BackgroundReconciler
) -> None:
    wanted = demand(namespace)
    running.update(by_name(wanted))
    [before] = tasks_are(api, {wanted.name})
    changed = dataclasses.replace(wanted, parameters={"grid": {"cells": []}, "rateHz": 5.0, "gone": None})
    running.update(by_name(changed))
    after = api.wait_for(
        "ApplicationTask",
        wanted.name,
        lambda task: task["spec"]["parameters"] == {"grid": {"cells": []}, "rateHz": 5},
        what="the parameters are those of the new demand",
    )
    assert after["metadata"]["uid"] == before["metadata"]["uid"]
    running.counted(DeployCounts(created=1, patched=1))


def test_a_task_with_changed_immutable_fields_is_recreated_under_the_same_name(
    api: Api, namespace: str, running: BackgroundReconciler
) -> None:
    wanted = demand(namespace)
    running.update(by_name(wanted))
    [before] = tasks_are(api, {wanted.name})
    running.update(by_name(dataclasses.replace(wanted, template="other-recorder")))
    after = api.wait_for(
        "ApplicationTask",
        wanted.name,
        lambda task: task["spec"]["templateName"] == "other-recorder",
        what="the task is for the new template",
    )
    assert after["metadata"]["uid"] != before["metadata"]["uid"]


def test_a_manually_deleted_live_task_is_recreated(api: Api, namespace: str, running: BackgroundReconciler) -> None:
    wanted = demand(namespace)
    running.update(by_name(wanted))
    [before] = tasks_are(api, {wanted.name})
    api.delete("ApplicationTask", wanted.name)
    api.wait_for(
        "ApplicationTask",
        wanted.name,
        lambda task: task["metadata"]["uid"] != before["metadata"]["uid"],
        what="the task exists again",
    )
    wait_until(lambda: running.counts, lambda counts: counts.recreated == 1, what="counted as created again")


def test_a_manually_ended_task_stays_ended(api: Api, namespace: str, running: BackgroundReconciler) -> None:
    wanted, other = demand(namespace), demand(namespace, "car3+car4")
    running.update(by_name(wanted))
    tasks_are(api, {wanted.name})
    api.patch("ApplicationTask", wanted.name, {"spec": {"endTime": "2026-01-01T00:00:01Z"}})
    running.update(by_name(wanted, other))
    tasks_are(api, {other.name}, {wanted.name})
    running.update({}, {wanted.name: START + 9 * SECOND, other.name: START + 9 * SECOND})
    tasks_are(api, set(), {wanted.name, other.name})
    assert api.get("ApplicationTask", wanted.name)["spec"]["endTime"] == "2026-01-01T00:00:01Z"
    assert not running.counts.refused


@pytest.mark.own_control_plane
def test_an_outage_delays_starts_and_ends_but_loses_none(
    control_plane: ControlPlane, api: Api, namespace: str, running: BackgroundReconciler
) -> None:
    stays, ends, starts, passes = (demand(namespace, subject) for subject in ("a+b", "c+d", "e+f", "g+h"))
    running.update(by_name(stays, ends))
    before = tasks_are(api, {stays.name, ends.name})
    with control_plane.outage():
        running.update(by_name(stays, passes), {ends.name: START + SECOND})
        wait_until(lambda: running.counts, lambda c: c.retried > 0, what="a write failed in the outage")
        running.update(by_name(stays, starts), {passes.name: START + 2 * SECOND})
    after = tasks_are(api, {stays.name, starts.name}, {ends.name})
    versions = {task["metadata"]["name"]: task["metadata"]["resourceVersion"] for task in before}
    for task in after:
        if task["metadata"]["name"] == stays.name:
            assert task["metadata"]["resourceVersion"] == versions[stays.name]
        if task["metadata"]["name"] == ends.name:
            assert task["spec"]["endTime"] == "2026-01-01T00:00:01.123456789Z"


@pytest.mark.own_control_plane
def test_an_end_that_a_stopped_detector_could_not_write_is_written_by_the_next(
    control_plane: ControlPlane, api: Api, namespace: str
) -> None:
    wanted = demand(namespace)
    with background(control_plane.kubeconfig) as loop:
        first = BackgroundReconciler(loop, namespace, HOLDER, RARELY)
        first.update(by_name(wanted))
        tasks_are(api, {wanted.name})
        with control_plane.outage():
            first.update({}, {wanted.name: START + SECOND})
            first.stop(deadline=0.2)
        [task] = tasks_are(api, {wanted.name})
        second = BackgroundReconciler(loop, namespace, HOLDER, RARELY)
        assert second.restored() == [wanted]
        assert not is_ended(api.get("ApplicationTask", wanted.name)), "tasks end only once the engine has reported"
        second.update({}, {wanted.name: START + 5 * SECOND})
        [ended] = tasks_are(api, set(), {wanted.name})
        second.stop()
    assert ended["metadata"]["uid"] == task["metadata"]["uid"]
    assert ended["spec"]["endTime"] == "2026-01-01T00:00:05.123456789Z"


def test_a_detector_that_stops_leaves_its_live_tasks_alive_and_adopts_them(
    control_plane: ControlPlane, api: Api, namespace: str
) -> None:
    wanted, late = demand(namespace), demand(namespace, "car3+car4")
    with reconciling(control_plane.kubeconfig, namespace) as first:
        first.update(by_name(wanted))
        tasks_are(api, {wanted.name})
        first.update(by_name(wanted, late))  # stopped at once: pending writes are still done
    before = tasks_are(api, {wanted.name, late.name})
    with reconciling(control_plane.kubeconfig, namespace) as second:
        restored = second.restored()
        assert sorted(each.name for each in restored) == sorted([wanted.name, late.name])
        another = demand(namespace, "car5+car6")
        second.update(by_name(*restored, another))
        tasks_are(api, {wanted.name, late.name, another.name})
        second.counted(DeployCounts(created=1))
    for task in before:
        assert api.get("ApplicationTask", task["metadata"]["name"]) == task


def test_tasks_of_other_holders_are_left_alone(api: Api, namespace: str, running: BackgroundReconciler) -> None:
    wanted = demand(namespace)
    foreign = demand(namespace, "x+y", holder="intersection-b")
    usurped = task_manifest(to_task(wanted))
    usurped["metadata"]["labels"] = {"wayside.dev/holder": "intersection-b"}
    usurped["spec"]["requester"]["holder"] = "intersection-b"
    disguised = task_manifest(to_task(foreign))  # this holder's label, but another requester
    disguised["metadata"]["labels"] = {"wayside.dev/holder": HOLDER}
    persons = {
        "apiVersion": "wayside.dev/v1alpha1",
        "kind": "ApplicationTask",
        "metadata": {"name": "mine", "labels": {"wayside.dev/holder": HOLDER}},
        "spec": {"templateName": "scene-recorder"},
    }
    before = [api.create(each) for each in (usurped, disguised, persons)]
    other = demand(namespace, "car3+car4")
    running.update(by_name(wanted, other))
    tasks_are(api, {wanted.name, foreign.name, "mine", other.name})
    wait_until(lambda: running.counts.refused, lambda r: bool(r["AlreadyExists"]), what="it was refused")
    running.update({}, {wanted.name: START, other.name: START})
    tasks_are(api, {wanted.name, foreign.name, "mine"}, {other.name})
    assert [api.get("ApplicationTask", each["metadata"]["name"]) for each in before] == before


def test_an_existing_task_is_distinguished_from_other_rejections(
    namespace: str, running: BackgroundReconciler, api: Api
) -> None:
    wanted = demand(namespace)
    running.update(by_name(wanted))
    tasks_are(api, {wanted.name})
    with pytest.raises(TaskExistsError, match="already exists"):
        running._loop.call(running.store.create(to_task(wanted)))


def test_a_forbidden_write_is_retried_until_it_is_allowed(
    control_plane: ControlPlane, api: Api, namespace: str
) -> None:
    wanted = demand(namespace)
    role = {"apiGroup": "rbac.authorization.k8s.io", "kind": "Role", "name": "reads"}
    api.create(_role("reads", ["get", "list", "watch"]))
    api.create(_binding("reads", role, namespace))
    kubeconfig = control_plane.kubeconfig_of_service_account(namespace, "default")
    with reconciling(kubeconfig, namespace, resync=1.0) as running:
        running.update(by_name(wanted))
        wait_until(lambda: running.counts.refused, lambda r: r["Forbidden"] > 0, what="it was refused")
        assert api.list("ApplicationTask") == []
        api.apply(_role("reads", ["get", "list", "watch", "create", "patch"]))
        tasks_are(api, {wanted.name})


def test_each_demand_of_a_burst_is_served_once(api: Api, namespace: str, running: BackgroundReconciler) -> None:
    wanted = by_name(*(demand(namespace, f"car{number}+rsu") for number in range(300)))
    running.update(wanted)
    tasks_are(api, set(wanted))
    running.update({}, dict.fromkeys(wanted, START + SECOND))
    tasks_are(api, set(), set(wanted))
    running.counted(DeployCounts(created=300, ended=300))


def _role(name: str, verbs: list[str]) -> Object:
    return {
        "apiVersion": "rbac.authorization.k8s.io/v1",
        "kind": "Role",
        "metadata": {"name": name},
        "rules": [{"apiGroups": ["wayside.dev"], "resources": ["applicationtasks"], "verbs": verbs}],
    }


def _binding(name: str, role: Object, namespace: str) -> Object:
    return {
        "apiVersion": "rbac.authorization.k8s.io/v1",
        "kind": "RoleBinding",
        "metadata": {"name": name},
        "roleRef": role,
        "subjects": [{"kind": "ServiceAccount", "name": "default", "namespace": namespace}],
    }
