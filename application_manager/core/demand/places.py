"""Decides which of the demanded or existing instances run within limits. Pure.

Two limits may apply at once: a template's `maxInstances`, and the namespace's limit. The order is: first, instances
that may not be stopped (held or paused by a person, or younger than their `minUptime`); then the demanded ones, by
the priority of their first task, with equal priority those that run already, then the older demand; last, the lingering
ones, the latest deadline first. So a higher priority preempts, an equal one never does, and lingering instances yield
first.

An instance counts until it is deleted. So an instance that takes the place of another waits for the deletion, and no
limit is exceeded.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

Rank = tuple[int, str, str]
"""The priority (negated), creation time and name of a demand's first task."""

BASELINE_RANK: Rank = (1_000_001, "", "")
"""The rank of a template's own demand, below all tasks."""


@dataclass(frozen=True, slots=True)
class PlaceCandidate:
    """An instance that is demanded, or exists.

    Attributes:
        rank: of its demand; None without demand.
        exists: whether it exists, or is being created.
        leaving: whether it is being deleted: it still counts, but not as running already.
        kept: whether it stays regardless of the limit: a person holds or pauses it, or it waits for its template.
        protected_until: the end of its minUptime, in seconds since 1970.
        deadline: the end of its linger, in seconds since 1970.
        ran: whether it served its demand before.
    """

    name: str
    template: str
    rank: Rank | None
    exists: bool = False
    leaving: bool = False
    kept: bool = False
    protected_until: float = 0.0
    deadline: float | None = None
    ran: bool = False

    @property
    def priority(self) -> int:
        """The priority of its first task; without demand, below all others."""
        return -(self.rank or BASELINE_RANK)[0]

    @property
    def text(self) -> str:
        """The instance and its first task, for messages."""
        task = f" (task {self.rank[2]}, priority {self.priority})" if self.rank and self.rank[2] else ""
        return f"instance {self.name}{task}"


@dataclass(frozen=True, slots=True)
class Limits:
    """The maximum number of instances: of each template with a limit, and of the namespace."""

    templates: Mapping[str, int] = field(default_factory=dict)
    namespace: int | None = None

    def __bool__(self) -> bool:
        return bool(self.templates) or self.namespace is not None


@dataclass(frozen=True, slots=True)
class GrantedPlace:
    """The result for an instance.

    Attributes:
        granted: whether it has a place; otherwise it does not start, and is released if it exists.
        preempts: the instance whose place it has, as text; empty if there is none.
        awaits: the instances that must be deleted before it may start, as text; empty if it may start.
        limit: without a place: the limit, as text.
        yields_to: without a place, if it ran before: the instance that has its place, as text.
        outbid_from: without a place: the priority that would get one; None if there is none.
        next_change: when this changes by itself, in seconds since 1970.
    """

    granted: bool = True
    preempts: str = ""
    awaits: str = ""
    limit: str = ""
    yields_to: str = ""
    outbid_from: int | None = None
    next_change: float | None = None

    @property
    def starts(self) -> bool:
        """Whether it may run now."""
        return self.granted and not self.awaits


@dataclass(frozen=True, slots=True)
class PlaceRequest:
    """The request of an instance for a place; `candidate` None if it needs no place.

    `next_change`: when that changes by itself, in seconds since 1970; None: never.
    """

    candidate: PlaceCandidate | None
    next_change: float | None


_NOTHING = PlaceRequest(None, None)


@dataclass(frozen=True, slots=True)
class Placement:
    """The places of one namespace, and the requests on which they are based, by name of the instance.

    `until`: when the places change by themselves, in seconds since 1970.
    """

    limits: Limits
    requests: Mapping[str, PlaceRequest] = field(default_factory=dict)
    granted: Mapping[str, GrantedPlace] = field(default_factory=dict)
    until: float = -math.inf

    def due(self, now: float) -> set[str]:
        """The instances whose requests have changed by themselves; `now` is in seconds since 1970."""
        times = ((name, each.next_change) for name, each in self.requests.items())
        return {name for name, when in times if when is not None and when <= now}

    def updated(self, requests: Mapping[str, PlaceRequest], limits: Limits, now: float) -> Placement:
        """The placement after these requests replace the previous ones of their instances."""
        changed = {name: each for name, each in requests.items() if self.requests.get(name, _NOTHING) != each}
        stale = now >= self.until or limits != self.limits
        if not changed and not stale:
            return self
        merged = {name: each for name, each in {**self.requests, **changed}.items() if each != _NOTHING}
        if not stale and all(
            self.requests.get(name, _NOTHING).candidate == each.candidate for name, each in changed.items()
        ):
            return replace(self, requests=merged)
        candidates = [each.candidate for each in merged.values() if each.candidate is not None]
        ends = [each.protected_until for each in candidates if now < each.protected_until]
        return Placement(limits, merged, places(candidates, limits, now), min(ends, default=math.inf))

    def changed_since(self, before: Placement | None) -> set[str]:
        """The instances whose result differs from the previous placement."""
        then: Mapping[str, GrantedPlace] = before.granted if before is not None else {}
        if then is self.granted:
            return set()
        return {name for name in self.granted.keys() | then.keys() if self.granted.get(name) != then.get(name)}


def places(candidates: Iterable[PlaceCandidate], limits: Limits, now: float) -> dict[str, GrantedPlace]:
    """The result for each candidate of one namespace, by name; `now` is in seconds since 1970."""
    everybody = sorted(candidates, key=lambda each: each.name)
    fixed = [each for each in everybody if _is_fixed(each, now)]
    free = sorted((each for each in everybody if not _is_fixed(each, now)), key=_order)
    room = _Room(limits)
    beyond: dict[str, str] = {}
    for each in fixed:
        room.take(each)
    for each in free:
        if each.leaving and each.rank is None:
            beyond[each.name] = "is being deleted"
        elif limit := room.lacks(each):
            beyond[each.name] = limit
        else:
            room.take(each)
    chosen = [each for each in [*fixed, *free] if each.name not in beyond]
    losers = [each for each in free if each.name in beyond and each.rank is not None]
    by = _preemptions(chosen, losers, limits)
    victims = {winner.name: loser for loser, winner in by.values()}
    result = {each.name: GrantedPlace(granted=False, limit=beyond[each.name]) for each in free if each.name in beyond}
    result |= {
        each.name: GrantedPlace(preempts=victims[each.name].text if each.name in victims else "") for each in chosen
    }
    bars = _bars(chosen, limits, now)
    for each in losers:
        bar = bars.get("" if limits.namespace is not None else each.template, GrantedPlace(granted=False))
        yields_to = by[each.name][1].text if each.name in by else ""
        result[each.name] = replace(bar, limit=beyond[each.name], yields_to=yields_to)
    result |= _waiting(everybody, chosen, result, limits)
    return result


def _is_fixed(each: PlaceCandidate, now: float) -> bool:
    return each.exists and not each.leaving and (each.kept or now < each.protected_until)


def _order(each: PlaceCandidate) -> tuple[object, ...]:
    if each.rank is None:
        return (1, -(each.deadline or 0.0), False, "", "", each.name)
    negated, created, task = each.rank
    return (0, negated, not each.exists or each.leaving, created, task, each.name)


class _Room:
    """The number of places taken, by limit."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._taken: Counter[str] = Counter()
        self._total = 0

    def take(self, each: PlaceCandidate) -> None:
        self._taken[each.template] += 1
        self._total += 1

    def lacks(self, each: PlaceCandidate) -> str:
        """The limit that leaves no place for it, as text; empty if there is a place."""
        own, all_ = self._limits.templates.get(each.template), self._limits.namespace
        if own is not None and self._taken[each.template] >= own:
            return f"template {each.template} is at its limit of {_instances(own)} (spec.maxInstances)"
        if all_ is not None and self._total >= all_:
            return f"the namespace is at its limit of {_instances(all_)} (--max-instances of the manager)"
        return ""


def _instances(count: int) -> str:
    return "1 instance" if count == 1 else f"{count} instances"


def _rivals(each: PlaceCandidate, others: Iterable[PlaceCandidate], limits: Limits) -> Iterator[PlaceCandidate]:
    """The candidates that compete for the same limit."""
    for other in others:
        if other.name != each.name and (limits.namespace is not None or other.template == each.template):
            yield other


def _preemptions(
    chosen: list[PlaceCandidate], losers: list[PlaceCandidate], limits: Limits
) -> dict[str, tuple[PlaceCandidate, PlaceCandidate]]:
    """The preemptions: by the name of each instance that lost its place, itself and the one that has its place.

    The last in order is preempted by the first of those behind it with a higher priority.
    """
    found: dict[str, tuple[PlaceCandidate, PlaceCandidate]] = {}
    left = sorted((each for each in chosen if each.rank is not None), key=_order)
    for loser in reversed(losers):
        if not loser.ran or loser.rank is None:
            continue
        higher = [each for each in _rivals(loser, left, limits) if each.priority > loser.priority]
        later = [each for each in higher if each.rank is not None and each.rank[1] >= loser.rank[1]]
        if winner := next(iter(later or higher), None):
            found[loser.name] = (loser, winner)
            left.remove(winner)
    return found


def _bars(chosen: Iterable[PlaceCandidate], limits: Limits, now: float) -> dict[str, GrantedPlace]:
    """The priority that would get a place, and when the first of the placed instances may be stopped.

    By template; by an empty name that of all instances, if the namespace has a limit.
    """
    groups: dict[str, list[PlaceCandidate]] = {}
    for each in chosen:
        groups.setdefault("" if limits.namespace is not None else each.template, []).append(each)
    found = {}
    for name, members in groups.items():
        movable = [each for each in members if not each.kept]
        lowest = min((each.priority for each in movable), default=None)
        ends = [each.protected_until for each in movable if now < each.protected_until]
        outbid_from = None if lowest is None else max(lowest, -BASELINE_RANK[0]) + 1
        found[name] = GrantedPlace(granted=False, outbid_from=outbid_from, next_change=min(ends, default=None))
    return found


def _waiting(
    everybody: list[PlaceCandidate], chosen: list[PlaceCandidate], so_far: Mapping[str, GrantedPlace], limits: Limits
) -> dict[str, GrantedPlace]:
    """The results of the instances that have a place, and wait until others are deleted."""
    room = _Room(limits)
    for each in everybody:
        if each.exists:
            room.take(each)
    leaving = [each for each in everybody if each.exists and (each.leaving or not so_far[each.name].granted)]
    found = {}
    for each in sorted((each for each in chosen if not each.exists), key=_order):
        if room.lacks(each):
            names = ", ".join(other.name for other in _rivals(each, leaving, limits))
            found[each.name] = GrantedPlace(preempts=so_far[each.name].preempts, awaits=names or "another")
        else:
            room.take(each)
    return found
