"""Leases expire by observation, on a clock that runs only while the API server is reachable."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

from kubernetes.aio.client import Configuration

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.cache.store import Entry
from application_manager.core.holders.leases import (
    LONGEST_POLL_PAUSE,
    HealthyTime,
    LeaseIndex,
    LeaseView,
)
from application_manager.core.objects.policy import Policy
from application_manager.watching.leasewatch import LeaseWatch
from tests.unit.manager_objects import task, template
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.leases import DEFAULT_DURATION, lease_name
from wayside.kubernetes.resources import LEASES, Resource

KEY = ("site", "det")


def lease(renewed: str, duration: int = 3, **metadata: Any) -> dict[str, Any]:
    return {
        "metadata": {"uid": "u", **metadata},
        "spec": {"holderIdentity": "det", "leaseDurationSeconds": duration, "renewTime": renewed},
    }


def test_the_age_of_a_lease_is_the_observed_time_without_change() -> None:
    index = LeaseIndex()
    assert index.observe(KEY, lease("2020-01-01T00:00:00Z"), 10.0) is False
    index.observe(KEY, lease("2020-01-01T00:00:00Z"), 12.0)
    assert index.view(KEY) == LeaseView(2.0, 3.0, renewed=False)
    assert index.observe(KEY, lease("2020-01-01T00:00:01Z"), 13.0) is True
    index.observe(KEY, lease("2020-01-01T00:00:01Z"), 14.5)
    assert index.view(KEY) == LeaseView(1.5, 3.0, renewed=True)


def test_time_without_observations_does_not_count() -> None:
    index = LeaseIndex()
    index.observe(KEY, lease("a"), 0.0)
    assert index.view(KEY).unchanged == 0.0
    assert not index.due(KEY, 2.9)
    assert index.due(KEY, 3.0)


def test_overdue_leases_are_read_with_growing_intervals() -> None:
    index = LeaseIndex()
    index.observe(KEY, lease("a"), 0.0)
    looks = []
    for at in range(3, 200):
        if index.due(KEY, float(at)):
            index.observe(KEY, lease("a"), float(at))
            looks.append(at)
    pauses = [later - earlier for earlier, later in itertools.pairwise(looks)]
    assert looks[0] == 3
    assert pauses == sorted(pauses)
    assert (pauses[0], pauses[-1]) == (1, LONGEST_POLL_PAUSE)
    assert all(later - 3 <= (earlier - 3) * 1.25 + 1 for earlier, later in itertools.pairwise(looks))


def test_an_unchanged_lease_is_not_a_renewal() -> None:
    index = LeaseIndex()
    index.observe(KEY, lease("a"), 0.0)
    assert index.observe(KEY, lease("a", resourceVersion="9", labels={"x": "y"}), 6.0) is False
    assert index.view(KEY).unchanged == 6.0


def test_a_new_lease_is_a_renewal_and_a_deleted_one_is_not() -> None:
    index = LeaseIndex()
    index.observe(KEY, lease("a"), 0.0)
    assert index.observe(KEY, None, 4.0) is False
    index.observe(KEY, None, 5.0)
    assert index.view(KEY).unchanged == 5.0
    assert index.observe(KEY, lease("a"), 6.0) is True
    assert index.view(KEY).unchanged == 0.0


def test_the_first_observation_of_a_lease_is_not_a_renewal_even_after_an_earlier_request() -> None:
    index = LeaseIndex()
    index.expect(KEY, 1.0)
    assert index.view(KEY).unchanged == 0.0
    assert not index.seen(KEY)
    assert index.due(KEY, 1.0)
    assert index.observe(KEY, lease("a"), 2.0) is False
    assert index.seen(KEY)
    assert index.view(KEY) == LeaseView(0.0, 3.0, renewed=False)
    assert index.observe(KEY, lease("b"), 4.0) is True


def test_a_lease_that_appears_after_it_was_missing_is_a_renewal() -> None:
    index = LeaseIndex()
    index.expect(KEY, 1.0)
    index.observe(KEY, None, 2.0)
    assert index.observe(KEY, lease("a"), 3.0) is True
    assert index.view(KEY).renewed


def test_a_holder_without_a_lease_counts_from_its_first_mention() -> None:
    index = LeaseIndex()
    assert index.view(KEY) == LeaseView(0.0, DEFAULT_DURATION, renewed=False)  # which changes nothing
    index.expect(KEY, 7.0)
    assert index.view(KEY) == LeaseView(0.0, DEFAULT_DURATION, renewed=False)
    index.observe(KEY, None, 9.0)
    assert index.view(KEY).unchanged == 2.0


def test_leases_without_demands_are_forgotten() -> None:
    index = LeaseIndex()
    index.observe(KEY, lease("a"), 0.0)
    index.forget_except([])
    assert index.view(KEY).unchanged == 0.0


def test_time_during_an_outage_does_not_count() -> None:
    time = HealthyTime(longest=5)
    for now, succeeded in ((0, True), (1, True), (2, False), (20, False), (21, True), (22, True)):
        time.note_check(float(now), succeeded=succeeded)
    assert time.elapsed == 2.0


def test_time_while_the_manager_was_suspended_does_not_count() -> None:
    time = HealthyTime(longest=5)
    for now in (0.0, 60.0, 61.0):
        time.note_check(now, succeeded=True)
    assert time.elapsed == 1.0


class _OneUnreadable(Client):
    """An API server that answers for all Leases but one."""

    async def get(self, resource: Resource, namespace: str, name: str) -> dict[str, Any] | None:
        if name == lease_name("bad"):
            raise ApiError(500, "cannot be decoded")
        return lease(name)


def test_a_lease_that_cannot_be_read_does_not_keep_the_others_from_being_read() -> None:
    cache = ClusterCache(Policy())
    holders = ("a", "bad", "c")
    for holder in holders:
        wanted = task(holder, of=holder, holder=holder)
        cache.claims.note(("site", holder), Entry(wanted.to_json(), wanted), template(holder))
    requested: list[tuple[str, str]] = []

    async def read() -> None:
        client = _OneUnreadable(Configuration(), "test", field_manager="test")
        await LeaseWatch(cache, client, LEASES, (), requested.append).read_due()
        await client.close()

    asyncio.run(read())
    assert sorted(requested) == [("site", "a"), ("site", "c")]
    assert [holder for holder in holders if cache.leases.due(("site", holder), 0.0)] == ["bad"]
