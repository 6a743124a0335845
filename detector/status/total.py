"""The sum of the statuses of several detectors, e.g. of a city with one detector per region."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import msgspec

from detector.status.model import (
    ActionStatus,
    Drops,
    Histogram,
    RuleState,
    RuleStatus,
    Status,
    StreamStatus,
    TaskStatus,
)

_BY_SEVERITY = (RuleState.REFUSED, RuleState.DEGRADED, RuleState.PAUSED, RuleState.DISABLED, RuleState.ACCEPTED)


class DetectorShare(msgspec.Struct, frozen=True, rename="camel"):
    """The part of one detector."""

    holder: str
    version: str
    uptime: float
    """Seconds."""
    connected: bool
    clients: int
    rate: float
    """Samples per second, over all streams."""
    buffered_bytes: int
    maximum_bytes: int
    behind: float
    """Seconds between the status and the last evaluated tick."""
    open: int
    """Number of open episodes."""
    demands: int
    lost: int
    """Losses of all causes."""


class Total(msgspec.Struct, frozen=True, rename="camel"):
    """The sum of statuses. A client or an episode seen by several detectors is counted once for each of them."""

    detectors: list[DetectorShare]
    """By holder."""
    missing_detectors: list[str]
    """Expected detectors that did not respond: the sums do not include them."""
    client_count: int
    shared_client_count: int
    """Number of clients that several detectors list; a lower bound if `clients_complete` is false."""
    shared_clients: list[str]
    """At most 200 of them, by name."""
    clients_complete: bool
    """Whether each detector lists all of its clients."""
    streams: list[StreamStatus]
    rules: list[RuleStatus]
    actions: list[ActionStatus]
    drops: list[Drops]
    demand_count: int
    tasks: TaskStatus
    missing_count: int
    """Expected clients that send nothing."""
    gaps: int
    buffered_bytes: int
    maximum_bytes: int


_CLIENTS = 200


def total(statuses: Iterable[Status], missing_detectors: Iterable[str] = ()) -> Total:
    """Add up the statuses, in any order. Streams, rules, actions and losses are joined by their names."""
    each = sorted(statuses, key=lambda status: status.holder)
    seen = Counter(client.name for status in each for client in status.clients)
    shared = sorted(name for name, detectors in seen.items() if detectors > 1)
    return Total(
        detectors=[_share(status) for status in each],
        missing_detectors=sorted(missing_detectors),
        client_count=sum(status.client_count for status in each),
        shared_client_count=len(shared),
        shared_clients=shared[:_CLIENTS],
        clients_complete=all(len(status.clients) == status.client_count for status in each),
        streams=_joined(((s.holder, stream) for s in each for stream in s.streams), lambda it: it.name, _stream),
        rules=_joined(((s.holder, rule) for s in each for rule in s.rules), lambda it: it.name, _rule),
        actions=_joined(
            ((s.holder, it) for s in each for it in s.actions), lambda it: f"{it.rule}/{it.action}", _action
        ),
        drops=_joined(
            ((s.holder, it) for s in each for it in s.drops), lambda it: (it.cause, it.stream, it.rule), _drops
        ),
        demand_count=sum(status.demand_count for status in each),
        tasks=_tasks([status.tasks for status in each]),
        missing_count=sum(status.missing_count for status in each),
        gaps=sum(status.gaps for status in each),
        buffered_bytes=sum(status.buffered_bytes for status in each),
        maximum_bytes=sum(status.maximum_bytes for status in each),
    )


def only_rule(added: Total, rule: str) -> Total:
    """The same with only this rule and its actions and losses."""
    return msgspec.structs.replace(
        added,
        rules=[each for each in added.rules if each.name == rule],
        actions=[each for each in added.actions if each.rule == rule],
        drops=[each for each in added.drops if each.rule == rule],
    )


def _share(status: Status) -> DetectorShare:
    return DetectorShare(
        holder=status.holder,
        version=status.version,
        uptime=status.taken - status.started,
        connected=status.connected,
        clients=status.client_count,
        rate=sum(stream.rate for stream in status.streams),
        buffered_bytes=status.buffered_bytes,
        maximum_bytes=status.maximum_bytes,
        behind=status.taken - status.now,
        open=sum(rule.open for rule in status.rules),
        demands=status.demand_count,
        lost=sum(drops.count for drops in status.drops),
    )


_Item = TypeVar("_Item", bound=msgspec.Struct)
_Key = TypeVar("_Key")


def _joined(
    items: Iterable[tuple[str, _Item]],
    key: Callable[[_Item], _Key],
    add: Callable[[Sequence[tuple[str, _Item]]], _Item],
) -> list[_Item]:
    """The sum of the items of each key, in the order in which the keys appear."""
    by_key: dict[_Key, list[tuple[str, _Item]]] = {}
    for holder, item in items:
        by_key.setdefault(key(item), []).append((holder, item))
    return [add(found) for found in by_key.values()]


def _summed(items: Sequence[_Item], **given: Any) -> _Item:
    """The first item with the sums of all its numbers, and with the given fields."""
    first = items[0]
    sums = {
        name: sum(getattr(each, name) for each in items)
        for name in first.__struct_fields__
        if name not in given and isinstance(getattr(first, name), int | float)
    }
    return msgspec.structs.replace(first, **sums, **given)


def _stream(found: Sequence[tuple[str, StreamStatus]]) -> StreamStatus:
    streams = [stream for _, stream in found]
    age = min((each.age for each in streams if each.age is not None), default=None)
    return _summed(streams, age=age, latency=_histogram([each.latency for each in streams]))


def _rule(found: Sequence[tuple[str, RuleStatus]]) -> RuleStatus:
    """The state is the worst one; the message names the detectors in that state."""
    rules = [rule for _, rule in found]
    state = min((each.state for each in rules), key=_BY_SEVERITY.index)
    worst = [(holder, each) for holder, each in found if each.state is state]
    where = ", ".join(holder for holder, _ in worst)
    reasons = sorted({each.message for _, each in worst if each.message})
    absences: Counter[str] = Counter()
    for each in rules:
        absences.update(each.absences)
    timed = [each.latency for each in rules if each.latency is not None]
    return _summed(
        rules,
        state=state,
        message="" if state is RuleState.ACCEPTED else ": ".join([f"{state.value} at {where}", *reasons]),
        absences=dict(absences),
        last_error=_named((holder, each.last_error) for holder, each in found),
        latency=_histogram(timed) if timed else None,
    )


def _action(found: Sequence[tuple[str, ActionStatus]]) -> ActionStatus:
    """Without `current`: the messages of running episodes belong to one detector."""
    return _summed(
        [action for _, action in found],
        current={},
        last_file=_named((holder, each.last_file) for holder, each in found),
        last_failure=_named((holder, each.last_failure) for holder, each in found),
    )


def _drops(found: Sequence[tuple[str, Drops]]) -> Drops:
    return _summed([drops for _, drops in found], last=_named((holder, each.last) for holder, each in found))


def _tasks(found: Sequence[TaskStatus]) -> TaskStatus:
    refused: Counter[str] = Counter()
    for each in found:
        refused.update(each.refused)
    return _summed(found, refused=dict(refused)) if found else TaskStatus()


def _named(texts: Iterable[tuple[str, str]]) -> str:
    return "; ".join(f"{holder}: {text}" for holder, text in texts if text)


def _histogram(histograms: Sequence[Histogram]) -> Histogram:
    """The sum; histograms whose bounds differ from the first (of another version) are left out."""
    alike = [each for each in histograms if each.bounds == histograms[0].bounds]
    return Histogram(
        bounds=histograms[0].bounds,
        counts=tuple(map(sum, zip(*(each.counts for each in alike), strict=True))),
        sum=sum(each.sum for each in alike),
    )
