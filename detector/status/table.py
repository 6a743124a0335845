"""A status as tables for terminals."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence

from rich.console import Group, RenderableType
from rich.table import Table

from detector.status.model import (
    TASK_CHANGES,
    ActionStatus,
    Drops,
    Histogram,
    RuleExplanation,
    RuleStatus,
    Status,
    StreamStatus,
    TaskStatus,
)
from detector.status.total import Total

_CLIENTS = 20
_DEMANDS = 10


def status_view(status: Status) -> RenderableType:
    """A status as a few tables."""
    return Group(*_parts(status))


def total_view(total: Total) -> RenderableType:
    """The sum of several statuses as a few tables, and a line for each detector."""
    return Group(*_sums(total))


def _sums(total: Total) -> Iterator[RenderableType]:
    least = "" if total.clients_complete else "at least "
    shared = (
        f" ({least}{total.shared_client_count} of them known to several detectors)" if total.shared_client_count else ""
    )
    yield (
        f"{len(total.detectors)} detectors, {total.client_count} clients{shared}, {total.demand_count} demands, "
        f"buffer {_size(total.buffered_bytes)} of {_size(total.maximum_bytes)}, {total.gaps} gaps"
    )
    each = _table(
        "detector",
        "version",
        "up",
        "connected",
        "clients",
        "per s",
        "size",
        "evaluated up to",
        "open",
        "demands",
        "lost",
    )
    for detector in total.detectors:
        each.add_row(
            detector.holder,
            detector.version,
            f"{detector.uptime:.0f} s",
            "yes" if detector.connected else "no",
            str(detector.clients),
            f"{detector.rate:.1f}",
            _size(detector.buffered_bytes),
            _ago(detector.behind),
            str(detector.open),
            str(detector.demands),
            str(detector.lost),
        )
    yield each
    yield _streams(total.streams)
    yield _rules(total.rules)
    for rule in total.rules:
        yield from _remarks(rule)
    yield from _acting(total.actions)
    yield from _tasks(total.tasks)
    yield from _lost(total.drops)
    if total.shared_clients:
        yield f"known to several detectors: {_listed(total.shared_clients, total.shared_client_count)}"
    if total.missing_count:
        yield f"missing: {total.missing_count} expected clients"


def _parts(status: Status) -> Iterator[RenderableType]:
    generation = f", generation {status.generation}" if status.generation else ""
    yield (
        f"detector {status.holder} (wayside {status.version}{generation}), clock {status.clock}, "
        f"up {status.taken - status.started:.0f} s, {'connected' if status.connected else 'not connected'}"
    )
    yield (
        f"buffer {_size(status.buffered_bytes)} of {_size(status.maximum_bytes)}, {status.client_count} clients, "
        f"{status.gaps} gaps; evaluated up to {_ago(status.taken - status.now)}"
    )
    yield from _proving(status)
    if status.explanation is None:
        yield _streams(status.streams)
        for source in status.sources:
            error = f"; last error: {source.last_error}" if source.last_error else ""
            yield f"source {source.name} ({source.plugin}): {source.state}, {source.messages} messages{error}"
    yield _rules(status.rules)
    for rule in status.rules:
        yield from _remarks(rule)
    of_rules = {rule.name for rule in status.rules}
    yield from _acting([each for each in status.actions if each.rule in of_rules or status.explanation is None])
    if status.explanation is None and status.demand_count:
        yield f"demands: {_listed(status.demands, status.demand_count, _DEMANDS)}"
    if status.explanation is None:
        yield from _tasks(status.tasks)
        if status.lease is not None:
            held = "held" if status.lease.held else "not held: this process creates no tasks"
            yield f"Lease {held}; {status.lease.failures} of {status.lease.attempts} renewals failed"
    if status.explanation is not None:
        yield from _explained(status.explanation)
        return
    yield from _lost(status.drops)
    if status.clients:
        known = [f"{client.name} ({_ago(client.age)})" for client in status.clients]
        yield f"clients: {_listed(known, status.client_count)}"
    if status.missing:
        yield f"missing: {_listed(status.missing, status.missing_count)}"


def _proving(status: Status) -> Iterator[RenderableType]:
    """The certificate of the detector, if it has one or there is a problem."""
    certificate = status.certificate
    if certificate.expires is not None:
        left = certificate.expires - status.taken
        lasts = f"expires in {_lasting(left)}" if left > 0 else f"expired {_lasting(-left)} ago"
        yield f"certificate {lasts}, renewed {certificate.renewals} times"
    if certificate.problem:
        yield f"new certificates not in use: {certificate.problem}"


def _streams(streams: Sequence[StreamStatus]) -> Table:
    table = _table("stream", "samples", "per s", "clients", "newest", "buffered", "size", "latency")
    for stream in streams:
        table.add_row(
            stream.name,
            str(stream.samples),
            f"{stream.rate:.1f}",
            str(stream.clients),
            "none" if stream.age is None else _ago(stream.age),
            str(stream.buffered_samples),
            _size(stream.buffered_bytes),
            _median(stream.latency),
        )
    return table


def _rules(rules: Sequence[RuleStatus]) -> Table:
    table = _table("rule", "state", "evaluations", "time", "latency", "unknowns", "errors", "open", "started", "ended")
    for rule in rules:
        table.add_row(
            rule.name,
            rule.state.value,
            str(rule.evaluations),
            f"{rule.time:.3f} s",
            _median(rule.latency),
            str(rule.unknowns),
            str(rule.errors),
            str(rule.open),
            str(rule.started),
            str(rule.ended),
        )
    return table


def _lost(drops: Sequence[Drops]) -> Iterator[RenderableType]:
    counted = [each for each in drops if each.count]
    if not counted:
        return
    table = _table("lost", "count", "the last")
    for each in counted:
        table.add_row(each.what, str(each.count), each.last)
    yield table


def _acting(actions: Sequence[ActionStatus]) -> Iterator[RenderableType]:
    """The outcomes of the actions."""
    if not actions:
        return
    table = _table("action", "kind", "running", "done", "failed", "samples", "missing", "size", "files")
    for each in actions:
        counts = (each.running, each.done, each.failed, each.samples, each.missing)
        table.add_row(
            f"{each.rule}/{each.action}",
            each.kind,
            *map(str, counts),
            _size(each.bytes),
            str(each.files),
        )
    yield table
    for each in actions:
        if each.last_file:
            yield f"{each.rule}/{each.action}: last file: {each.last_file}"
        if each.last_failure:
            yield f"{each.rule}/{each.action}: last failure: {each.last_failure}"
        for episode, message in each.current.items():
            if message:
                yield f"{each.rule}/{each.action}: episode {episode}: {message}"


def _tasks(tasks: TaskStatus) -> Iterator[RenderableType]:
    """The changes of tasks by the deploy actions, if there are any."""
    counts = {name: getattr(tasks, name) for name in (*TASK_CHANGES, "retried", "pending")}
    if any(counts.values()):
        yield "tasks: " + ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    if tasks.refused:
        yield "tasks refused: " + ", ".join(f"{count} {reason}" for reason, count in sorted(tasks.refused.items()))


def _explained(explanation: RuleExplanation) -> Iterator[RenderableType]:
    for subject in explanation.subjects:
        if not subject.evaluated:
            yield f"{subject.subject}: not evaluated: {subject.why}"
            continue
        state = "an episode is open" if subject.open else "no episode"
        if subject.pending is not None:
            state = f"when has been true for {subject.pending:.1f} s"
        truths = (
            ("in scope", subject.in_scope),
            ("near", subject.near),
            ("when", subject.when),
            ("until", subject.until),
        )
        yield f"{subject.subject}: {state}; " + ", ".join(f"{what} {_truth(value)}" for what, value in truths)
        for name, value in subject.values.items():
            yield f"    {name} = {json.dumps(value, ensure_ascii=False):.120}"
        for name, why in subject.unknown.items():
            yield f"    {name} is unknown: {why}"
    for note in explanation.notes:
        yield f"in this evaluation: {note}"


def _listed(names: Sequence[str], count: int, most: int = _CLIENTS) -> str:
    """The first `most` of `count` names."""
    return ", ".join(names[:most]) + (f" and {count - most} more" if count > most else "")


def _truth(value: bool | None) -> str:
    return "unknown" if value is None else str(value).lower()


def _remarks(rule: RuleStatus) -> Iterator[str]:
    if rule.message:
        yield f"{rule.name}: {rule.message}"
    if rule.last_error:
        yield f"{rule.name}: last error: {rule.last_error}"
    for what, count in sorted(rule.absences.items(), key=lambda item: -item[1])[:3]:
        yield f"{rule.name}: {'once' if count == 1 else f'{count} times'} {what}"


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, no_wrap=column != "the last", overflow="fold")
    return table


def _median(histogram: Histogram | None) -> str:
    bound = None if histogram is None else histogram.quantile(0.5)
    if bound is None:
        return "-"
    return f"> {histogram.bounds[-1]:g} s" if math.isinf(bound) and histogram else f"≤ {bound * 1000:g} ms"


def _ago(seconds: float) -> str:
    return f"{seconds:.1f} s ago" if seconds < 120 else f"{seconds / 60:.0f} min ago"


def _lasting(seconds: float) -> str:
    return f"{seconds / 86400:.1f} days" if seconds >= 86400 else f"{seconds / 3600:.1f} hours"


def _size(count: int) -> str:
    for unit, step in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if count >= step:
            return f"{count / step:.1f} {unit}"
    return f"{count} B"
