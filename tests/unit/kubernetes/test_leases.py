"""Two managers never act at the same time, whatever is suspended, delayed or lost."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from application_manager.cluster.leadership import DEADLINE, DURATION, lease_key
from wayside.kubernetes.leases import LeaseCandidate

NAME, NAMESPACE = "application-manager", "wayside"
HORIZON = 200.0  # s of simulated time
CLOCKS = {"a": 0.0, "b": 1e6, "c": -5e3}  # what each one's clock shows at the start: they have nothing in common

Lease = dict[str, Any]


@dataclass
class Server:
    """Stores one Lease, with optimistic concurrency."""

    lease: Lease | None = None
    versions: Iterator[int] = field(default_factory=lambda: itertools.count(1))

    def write(self, draft: Lease) -> Lease | None:
        """The stored Lease; None for a conflict."""
        has = (self.lease or {"metadata": {}})["metadata"].get("resourceVersion")
        if draft["metadata"].get("resourceVersion") != has:
            return None
        self.lease = {
            **draft,
            "metadata": {**draft["metadata"], "uid": "u", "resourceVersion": str(next(self.versions))},
        }
        return self.lease


def two_candidates() -> tuple[Server, LeaseCandidate, LeaseCandidate]:
    """A server without a Lease, and two managers that want it."""
    return Server(), LeaseCandidate("first", DURATION, DEADLINE), LeaseCandidate("second", DURATION, DEADLINE)


def manager(
    candidate: LeaseCandidate,
    offset: float,
    server: Server,
    delay: Callable[[], float],
    now: list[float],
    spans: list[Any],
) -> Iterator[float]:
    """One manager as `leadership` is: yields for how long nothing happens to it."""
    while True:
        clock = now[0] + offset
        if candidate.remaining(clock) <= 0:
            yield delay()  # the request is under way
            read = server.lease
            yield delay()  # the answer is
            candidate.observe(read, now[0] + offset)
        sent = now[0] + offset
        if candidate.remaining(sent) > 0 or candidate.may_take(sent):
            draft = candidate.draft(NAME, NAMESPACE, now[0])
            yield delay()
            stored = server.write(draft)
            lost = delay()
            yield lost
            if stored is not None and lost < 8:  # else the answer never comes
                candidate.took(stored, sent, now[0] + offset)
                if candidate.remaining(now[0] + offset) > 0:
                    spans.append((candidate.identity, now[0], candidate.until - offset))
            elif stored is None:
                candidate.observe(server.lease, now[0] + offset)
        yield 1.0 + delay()


@given(st.lists(st.sampled_from([0.0, 0.01, 0.5, 1.5, 4.0, 9.0, 11.0, 13.0, 30.0]), min_size=1, max_size=60))
def test_never_two_may_act(delays: list[float]) -> None:
    server, now, spans = Server(), [0.0], []
    pauses = itertools.cycle(delays)
    running = {
        name: manager(LeaseCandidate(name, DURATION, DEADLINE), offset, server, lambda: next(pauses), now, spans)
        for name, offset in CLOCKS.items()
    }
    due = [(0.01 * index, name) for index, name in enumerate(running)]
    while due[0][0] < HORIZON:
        now[0], name = heapq.heappop(due)
        heapq.heappush(due, (now[0] + next(running[name]) + 1e-6, name))
    for one, other in itertools.combinations(spans, 2):
        if one[0] != other[0]:
            assert one[2] <= other[1] or other[2] <= one[1], (one, other)


def stored(candidate: LeaseCandidate, server: Server, now: float) -> None:
    lease = server.write(candidate.draft(NAME, NAMESPACE, now))
    assert lease is not None
    candidate.took(lease, now, now)


def test_a_standby_takes_the_lease_once_it_has_seen_it_unchanged_for_its_duration() -> None:
    server, first, second = two_candidates()
    stored(first, server, 0.0)
    assert first.remaining(1.0) == DEADLINE - 1.0
    second.observe(server.lease, 1000.0)
    assert not second.may_take(1000.0 + DURATION - 0.1)
    stored(first, server, 9.0)
    second.observe(server.lease, 1009.0)
    assert not second.may_take(1009.0 + DURATION - 0.1)
    assert second.may_take(1009.0 + DURATION)


def test_a_released_lease_is_taken_at_once() -> None:
    server, first, second = two_candidates()
    stored(first, server, 0.0)
    second.observe(server.lease, 0.0)
    released = first.released(1.0)
    assert released is not None
    server.write(released)
    second.observe(server.lease, 1.0)
    assert second.may_take(1.0)
    stored(second, server, 1.0)
    assert server.lease is not None
    assert server.lease["spec"]["leaseTransitions"] == 1
    assert second.released(2.0) is not None
    assert LeaseCandidate("third", DURATION, DEADLINE).released(2.0) is None


def test_a_container_that_starts_again_in_its_pod_need_not_wait_for_itself() -> None:
    server, again = Server(), LeaseCandidate("pod", DURATION, DEADLINE)
    stored(LeaseCandidate("pod", DURATION, DEADLINE), server, 0.0)
    again.observe(server.lease, 0.5)
    assert again.may_take(0.5)


def test_a_lease_that_vanishes_is_not_taken_before_its_manager_must_have_noticed() -> None:
    server, second = Server(), LeaseCandidate("second", DURATION, DEADLINE)
    assert second.may_take(0.0), "where none was ever seen"
    stored(LeaseCandidate("first", DURATION, DEADLINE), server, 0.0)
    second.observe(server.lease, 0.0)
    second.observe(None, 5.0)
    assert not second.may_take(5.0 + DURATION - 0.1)
    assert second.may_take(5.0 + DURATION)


def test_a_candidate_whose_lease_was_taken_may_not_act() -> None:
    server, first, second = two_candidates()
    stored(first, server, 0.0)
    second.observe(server.lease, 0.0)
    stored(second, server, DURATION)
    first.observe(server.lease, 1.0)
    assert first.remaining(1.0) <= 0


@pytest.mark.parametrize(
    ("given", "namespaces", "found"),
    [
        (None, (), "default/application-manager"),
        (None, ("south", "north"), "north/application-manager"),
        ("mine", ("north",), "north/mine"),
        ("system/mine", ("north",), "system/mine"),
    ],
)
def test_the_lease_is_in_the_given_or_the_managed_namespace(
    given: str | None, namespaces: tuple[str, ...], found: str
) -> None:
    assert str(lease_key(given, namespaces)) == found


def test_the_lease_of_a_pod_is_in_its_namespace(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POD_NAMESPACE", "system")
    assert str(lease_key(None, ("north",))) == "system/application-manager"


@pytest.mark.parametrize("given", ["wayside-town", "system/wayside-town", "system/"])
def test_an_invalid_lease_name_is_rejected(given: str) -> None:
    with pytest.raises(ValueError, match="must be NAME or NAMESPACE/NAME"):
        lease_key(given, ())
