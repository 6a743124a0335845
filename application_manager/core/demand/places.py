"""Which instances run within a limit, of all that are demanded or exist. Pure.

Two limits may hold at once: a template's `maxInstances`, and one for the namespace. The order is: what may not be
stopped (held or paused by a person, or younger than its `minimumUptime`); then what is demanded, by the priority of its
first task, of equal priority what runs already, then the older demand; last what lingers, the latest deadline first. So
a higher priority preempts, an equal one never does, and what lingers yields first.

An instance is counted until it is gone. So what gets the place of another waits for that, and no limit is exceeded.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

Rank = tuple[int, str, str]
"""Of a demand's first task: its priority negated, its creation, its name."""

BASELINE_RANK: Rank = (1_000_001, "", "")
"""A template's own demand, below all tasks."""


@dataclass(frozen=True, slots=True)
class PlaceCandidate:
    """An instance that is demanded, or there.

    Attributes:
        rank: of its demand; None where nobody demands it.
        exists: whether it is there, or being made.
        leaving: whether it is being deleted: it is there, and is no reason to keep it.
        kept: whether it stays whatever the limit: a person holds or pauses it, or it waits for its template.
        protected_until: the end of its minimumUptime, in seconds since 1970.
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
        """That of its first task; where nobody demands it, below all others."""
        return -(self.rank or BASELINE_RANK)[0]

    @property
    def text(self) -> str:
        """The instance and its first task, for messages."""
        task = f" (task {self.rank[2]}, priority {self.priority})" if self.rank and self.rank[2] else ""
        return f"instance {self.name}{task}"


@dataclass(frozen=True, slots=True)
class Limits:
    """How many instances there may be: of each template with a limit, and in the namespace."""

    templates: Mapping[str, int] = field(default_factory=dict)
    namespace: int | None = None

    def __bool__(self) -> bool:
        return bool(self.templates) or self.namespace is not None


@dataclass(frozen=True, slots=True)
class GrantedPlace:
    """What an instance gets.

    Attributes:
        given: whether it runs, or stays; otherwise it does not start, and goes if it is there.
        preempts: the one whose place it has, in words; empty where there is none.
        awaits: of one that is to run: the instances that must be gone first, in words; empty where it may start.
        limit: of one that is not to run: the limit that it is beyond, in words.
        yields_to: of one that is not to run and did before: who has its place, in words.
        outbid_from: of one that is not to run: the priority that would have a place; None where none would.
        next_change: when this changes by itself, in seconds since 1970.
    """

    given: bool = True
    preempts: str = ""
    awaits: str = ""
    limit: str = ""
    yields_to: str = ""
    outbid_from: int | None = None
    next_change: float | None = None

    @property
    def starts(self) -> bool:
        """Whether it may run now."""
        return self.given and not self.awaits


@dataclass(frozen=True, slots=True)
class PlaceRequest:
    """What an instance requests of the limits; `candidate` None where it takes no place.

    `next_change`: when that changes by itself, in seconds since 1970; None: not at all.
    """

    candidate: PlaceCandidate | None
    next_change: float | None


_NOTHING = PlaceRequest(None, None)


@dataclass(frozen=True, slots=True)
class Placement:
    """Who has a place in one namespace, and the requests that this follows from, by name of the instance.

    `until`: when places change by themselves, in seconds since 1970.
    """

    limits: Limits
    requests: Mapping[str, PlaceRequest] = field(default_factory=dict)
    given: Mapping[str, GrantedPlace] = field(default_factory=dict)
    until: float = -math.inf

    def due(self, now: float) -> set[str]:
        """The instances whose request has changed by itself; `now` in seconds since 1970."""
        times = ((name, each.next_change) for name, each in self.requests.items())
        return {name for name, when in times if when is not None and when <= now}

    def updated(self, requests: Mapping[str, PlaceRequest], limits: Limits, now: float) -> Placement:
        """The placement with these requests in place of the instances' former ones."""
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

    def moved(self, before: Placement | None) -> set[str]:
        """The instances whose place is another than before."""
        then: Mapping[str, GrantedPlace] = before.given if before is not None else {}
        if then is self.given:
            return set()
        return {name for name in self.given.keys() | then.keys() if self.given.get(name) != then.get(name)}


def places(candidates: Iterable[PlaceCandidate], limits: Limits, now: float) -> dict[str, GrantedPlace]:
    """What each candidate of one namespace gets, by name; `now` in seconds since 1970."""
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
    result = {each.name: GrantedPlace(given=False, limit=beyond[each.name]) for each in free if each.name in beyond}
    result |= {
        each.name: GrantedPlace(preempts=victims[each.name].text if each.name in victims else "") for each in chosen
    }
    bars = _bars(chosen, limits, now)
    for each in losers:
        bar = bars.get("" if limits.namespace is not None else each.template, GrantedPlace(given=False))
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
    """How much of the limits is taken."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._taken: Counter[str] = Counter()
        self._total = 0

    def take(self, each: PlaceCandidate) -> None:
        self._taken[each.template] += 1
        self._total += 1

    def lacks(self, each: PlaceCandidate) -> str:
        """The limit that leaves no room for it, in words; empty where there is room."""
        own, all_ = self._limits.templates.get(each.template), self._limits.namespace
        if own is not None and self._taken[each.template] >= own:
            return f"template {each.template} is at its limit of {_instances(own)} (spec.maxInstances)"
        if all_ is not None and self._total >= all_:
            return f"the namespace is at its limit of {_instances(all_)} (--max-instances of the manager)"
        return ""


def _instances(count: int) -> str:
    return "1 instance" if count == 1 else f"{count} instances"


def _rivals(each: PlaceCandidate, others: Iterable[PlaceCandidate], limits: Limits) -> Iterator[PlaceCandidate]:
    """Those that take places from the same limit."""
    for other in others:
        if other.name != each.name and (limits.namespace is not None or other.template == each.template):
            yield other


def _preemptions(
    chosen: list[PlaceCandidate], losers: list[PlaceCandidate], limits: Limits
) -> dict[str, tuple[PlaceCandidate, PlaceCandidate]]:
    """By the name of each that ran and has no place any more, itself and who has its place.

    The last in order gives way to the first of those that came after it with a higher priority.
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
    """What it takes to get a place among those that have one, and when the first of them may be stopped.

    By template; by an empty name that of all together, where the namespace has a limit.
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
        found[name] = GrantedPlace(given=False, outbid_from=outbid_from, next_change=min(ends, default=None))
    return found


def _waiting(
    everybody: list[PlaceCandidate], chosen: list[PlaceCandidate], so_far: Mapping[str, GrantedPlace], limits: Limits
) -> dict[str, GrantedPlace]:
    """The places of those that are to run, and wait until others are gone."""
    room = _Room(limits)
    for each in everybody:
        if each.exists:
            room.take(each)
    going = [each for each in everybody if each.exists and (each.leaving or not so_far[each.name].given)]
    found = {}
    for each in sorted((each for each in chosen if not each.exists), key=_order):
        if room.lacks(each):
            names = ", ".join(other.name for other in _rivals(each, going, limits))
            found[each.name] = GrantedPlace(preempts=so_far[each.name].preempts, awaits=names or "another")
        else:
            room.take(each)
    return found
