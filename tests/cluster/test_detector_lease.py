"""The holder's Lease: renewed while the detector runs, and never held by two processes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future
from datetime import datetime
from itertools import pairwise
from typing import Any

import pytest

from detector.actions.deploy.lease import HolderLease, ProcessIdentity
from tests.cluster.api import Api, Object
from tests.cluster.background import Background, background
from tests.cluster.controlplane import ControlPlane
from tests.cluster.waiting import wait_until
from tests.patience import PATIENCE
from wayside.kubernetes.leases import HOLDER_LEASE_LABEL

NAME = "wayside-intersection-a"
LONG = 600  # s: a Lease that outlasts every wait here


class LeaseCandidate:
    """The part of a detector process that acquires and renews the Lease."""

    def __init__(self, loop: Background, namespace: str, identity: ProcessIdentity, **options: Any):
        self._loop = loop
        self.lease = loop.call(self._make(namespace, identity, options))
        self._future: Future[None] = loop.start(self.lease.run())

    async def _make(self, namespace: str, identity: ProcessIdentity, options: dict[str, Any]) -> HolderLease:
        return HolderLease(self._loop.api, namespace, "intersection-a", identity, **options)

    @property
    def held(self) -> bool:
        return self.lease.held.is_set()

    def wait_held(self, held: bool = True) -> None:
        wait_until(lambda: self.held, lambda state: state is held, what=f"held is {held}")

    def looks(self) -> None:
        """Wait until the process has read the Lease again."""
        before = self.lease.attempts
        wait_until(lambda: self.lease.attempts, lambda n: n >= before + 2, what="it has read the Lease again")

    def stop(self) -> None:
        self._loop.loop.call_soon_threadsafe(self.lease.stop)
        self._future.result(PATIENCE)

    def die(self) -> None:
        """End as by kill -9, without releasing the Lease."""
        self._future.cancel()
        with pytest.raises(CancelledError):
            self._future.result(PATIENCE)


@pytest.fixture
def loop(control_plane: ControlPlane) -> Iterator[Background]:
    with background(control_plane.kubeconfig) as started:
        yield started


def renewals(api: Api, count: int) -> list[Object]:
    """The successive specs of the Lease."""
    seen: list[Object] = []

    def look() -> list[Object]:
        spec = api.get("Lease", NAME)["spec"]
        if not seen or seen[-1] != spec:
            seen.append(spec)
        return seen

    return wait_until(look, lambda specs: len(specs) >= count, what=f"{count} states of the Lease")


def another(api: Api, before: Object) -> Object:
    """The Lease's spec once it differs from `before`."""
    found = api.wait_for("Lease", NAME, lambda lease: lease["spec"] != before, what="the Lease is renewed")
    spec: Object = found["spec"]
    return spec


def moment(spec: Object) -> datetime:
    return datetime.fromisoformat(spec["renewTime"])


def test_the_lease_lasts_15_seconds_and_is_held_by_the_pod(
    api: Api, namespace: str, loop: Background, monkeypatch: pytest.MonkeyPatch
) -> None:
    pod = {"containers": [{"name": "detector", "image": "registry.example/detector:1"}]}
    created = api.create({"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "detector-1"}, "spec": pod})
    monkeypatch.setenv("POD_NAME", "detector-1")
    monkeypatch.setenv("POD_UID", created["metadata"]["uid"])
    LeaseCandidate(loop, namespace, ProcessIdentity.of_this_process()).wait_held()
    lease = api.get("Lease", NAME)
    assert lease["spec"]["leaseDurationSeconds"] == 15
    assert lease["spec"]["holderIdentity"] == "detector-1"
    [owner] = lease["metadata"]["ownerReferences"]
    assert (owner["kind"], owner["name"], owner["uid"]) == ("Pod", "detector-1", created["metadata"]["uid"])


def test_the_lease_is_renewed_after_each_third_of_its_duration(api: Api, namespace: str, loop: Background) -> None:
    LeaseCandidate(loop, namespace, ProcessIdentity("pod-1"), duration=15.0).wait_held()
    specs = renewals(api, 3)
    gaps = [(moment(after) - moment(before)).total_seconds() for before, after in pairwise(specs)]
    assert all(4.9 < gap < 15.0 for gap in gaps), gaps
    assert {spec["leaseTransitions"] for spec in specs} == {0}
    assert len({spec["acquireTime"] for spec in specs}) == 1


def test_a_manually_deleted_lease_is_recreated(api: Api, namespace: str, loop: Background) -> None:
    LeaseCandidate(loop, namespace, ProcessIdentity("pod-1"), duration=3.0).wait_held()
    api.delete("Lease", NAME)
    api.wait_for("Lease", NAME, lambda _: True, what="the Lease exists again")


def test_a_second_process_waits_until_the_lease_was_not_renewed_for_its_duration(
    api: Api, namespace: str, loop: Background, caplog: pytest.LogCaptureFixture
) -> None:
    first = LeaseCandidate(loop, namespace, ProcessIdentity("pod-1"), duration=3.0)
    first.wait_held()
    clock = [0.0]  # s of the second process, independent of the machine's speed
    second = LeaseCandidate(loop, namespace, ProcessIdentity("pod-2"), duration=3.0, monotonic=lambda: clock[0])
    seen = renewals(api, 1)[-1]
    for _ in range(4):  # for longer than the duration
        seen = another(api, seen)
        second.looks()
        clock[0] += 0.9
    assert first.held
    assert not second.held
    assert "held by pod-1" in caplog.text
    first.die()
    clock[0] += 2.0  # 2.9 s since the last renewal, if it was before the last read
    second.looks()
    assert not second.held
    clock[0] += 3.0
    second.wait_held()
    assert api.get("Lease", NAME)["spec"]["leaseTransitions"] == 1


def test_a_released_lease_is_acquired_at_once_with_the_full_duration(
    api: Api, namespace: str, loop: Background
) -> None:
    first = LeaseCandidate(loop, namespace, ProcessIdentity("pod-1"), duration=LONG)
    first.wait_held()
    first.stop()
    released = api.get("Lease", NAME)["spec"]
    assert released.get("holderIdentity") in {None, ""}
    assert released["leaseDurationSeconds"] == LONG, "the manager keeps counting the demands for the usual time"
    assert api.get("Lease", NAME)["metadata"]["labels"] == {HOLDER_LEASE_LABEL: "true"}
    api.patch("Lease", NAME, {"metadata": {"labels": {HOLDER_LEASE_LABEL: None, "team": "mobility"}}})
    LeaseCandidate(loop, namespace, ProcessIdentity("pod-2")).wait_held()
    labels = api.get("Lease", NAME)["metadata"]["labels"]
    assert labels == {HOLDER_LEASE_LABEL: "true", "team": "mobility"}, "as with a Lease of an older release"


def test_the_next_container_of_the_same_pod_takes_over_at_once(namespace: str, loop: Background) -> None:
    first = LeaseCandidate(loop, namespace, ProcessIdentity("pod-1"), duration=LONG)
    first.wait_held()
    first.die()
    LeaseCandidate(loop, namespace, ProcessIdentity("pod-1")).wait_held()


def test_the_lease_of_a_dead_local_process_is_taken_at_once_and_that_of_a_live_one_is_not(
    namespace: str, loop: Background
) -> None:
    own = ProcessIdentity.of_this_process()
    machine = own.text.removesuffix(str(os.getpid()))
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        first = LeaseCandidate(loop, namespace, ProcessIdentity(f"{machine}{other.pid}"), duration=LONG)
        first.wait_held()
        first.die()
        second = LeaseCandidate(loop, namespace, own)
        wait_until(lambda: second.lease.attempts, lambda n: n >= 2, what="it has tried twice")
        assert not second.held
        other.kill()
    second.wait_held()


def test_a_process_whose_lease_was_taken_over_no_longer_holds_it(
    api: Api, namespace: str, loop: Background, caplog: pytest.LogCaptureFixture
) -> None:
    first = LeaseCandidate(loop, namespace, ProcessIdentity("pod-1"), duration=3.0)
    first.wait_held()
    api.patch("Lease", NAME, {"spec": {"holderIdentity": "pod-2", "leaseDurationSeconds": LONG}})
    first.wait_held(False)
    wait_until(lambda: caplog.text, lambda text: "pod-2 took over" in text, what="the log reports it")


@pytest.mark.own_control_plane
def test_an_outage_does_not_lose_the_lease(
    control_plane: ControlPlane, api: Api, namespace: str, loop: Background
) -> None:
    holding = LeaseCandidate(loop, namespace, ProcessIdentity("pod-1"), duration=3.0)
    holding.wait_held()
    with control_plane.outage():
        wait_until(lambda: holding.lease.failures, lambda n: n >= 2, what="two renewals failed")
        assert holding.held
    before = api.get("Lease", NAME)["spec"]
    api.wait_for("Lease", NAME, lambda lease: lease["spec"] != before, what="the Lease is renewed again")
    assert holding.held
