"""A status as Prometheus metrics. Labels are streams, rules and causes, never clients, whose number is unbounded."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from detector.status.model import TASK_CHANGES, ActionStatus, Histogram, RuleState, RuleStatus, Status, StreamStatus

_PREFIX = "wayside_detector_"
_GAUGE, _COUNTER = GaugeMetricFamily, CounterMetricFamily

DETECTOR: tuple[tuple[str, type, str, Callable[[Status], float | None]], ...] = (
    ("connected", _GAUGE, "1 if a Zenoh router, peer or client is connected", lambda s: s.connected),
    ("start_time_seconds", _GAUGE, "Start time of the detector, in seconds since the epoch", lambda s: s.started),
    ("status_time_seconds", _GAUGE, "Time of this status, in seconds since the epoch", lambda s: s.taken),
    (
        "evaluated_time_seconds",
        _GAUGE,
        "Time axis position up to which all ticks were evaluated, in seconds since the epoch",
        lambda s: s.now,
    ),
    ("generation", _GAUGE, "Generation of the Detector in use; 0 if it is from a file", lambda s: s.generation),
    ("clients", _GAUGE, "Number of known clients", lambda s: s.client_count),
    ("gaps", _COUNTER, "Number of gaps at which missed ticks were skipped", lambda s: s.gaps),
    ("buffer_bytes", _GAUGE, "Size of the buffer in bytes, overhead included", lambda s: s.buffered_bytes),
    ("buffer_limit_bytes", _GAUGE, "Maximum size of the buffer in bytes, over all streams", lambda s: s.maximum_bytes),
    ("demands", _GAUGE, "Number of tasks that are currently demanded", lambda s: s.demand_count),
    ("tasks_pending", _GAUGE, "Number of tasks that wait for a change", lambda s: s.tasks.pending),
    (
        "task_retries",
        _COUNTER,
        "Number of changes of tasks that failed because the API server was unavailable or busy",
        lambda s: s.tasks.retried,
    ),
    (
        "lease_held",
        _GAUGE,
        "1 if this process holds its Lease and may emit tasks; absent without a cluster",
        lambda s: None if s.lease is None else s.lease.held,
    ),
    (
        "lease_failures",
        _COUNTER,
        "Number of failed attempts to acquire or renew the Lease; absent without a cluster",
        lambda s: None if s.lease is None else s.lease.failures,
    ),
    ("clients_missing", _GAUGE, "Number of expected clients that send nothing", lambda s: s.missing_count),
    (
        "certificate_expiry_time_seconds",
        _GAUGE,
        "Expiry of the certificate in use, in seconds since the epoch; absent without a certificate",
        lambda s: s.certificate.expires,
    ),
    (
        "certificate_refused",
        _GAUGE,
        "1 if the new certificates in the files cannot be used",
        lambda s: bool(s.certificate.problem),
    ),
    ("certificate_renewals", _COUNTER, "Number of certificate renewals", lambda s: s.certificate.renewals),
)
"""Without labels: name, kind, help text, and value; None: absent."""

STREAM: tuple[tuple[str, type, str, Callable[[StreamStatus], float | None]], ...] = (
    ("stream_samples", _COUNTER, "Number of samples added to the buffer", lambda s: s.samples),
    ("stream_samples_per_second", _GAUGE, "Samples per second, averaged over about ten seconds", lambda s: s.rate),
    ("stream_clients", _GAUGE, "Number of clients with buffered samples", lambda s: s.clients),
    ("stream_age_seconds", _GAUGE, "Age of the newest sample in seconds, on the time axis", lambda s: s.age),
    ("stream_buffered_samples", _GAUGE, "Number of samples in the buffer", lambda s: s.buffered_samples),
    (
        "stream_buffered_bytes",
        _GAUGE,
        "Size of the samples in the buffer in bytes, overhead included",
        lambda s: s.buffered_bytes,
    ),
)
"""By stream."""

RULE: tuple[tuple[str, type, str, Callable[[RuleStatus], float | None]], ...] = (
    ("rule_evaluations", _COUNTER, "Number of subjects evaluated", lambda r: r.evaluations),
    ("rule_ticks", _COUNTER, "Number of ticks at which the rule was evaluated, for all subjects", lambda r: r.ticks),
    ("rule_evaluation_seconds", _COUNTER, "Time spent on evaluations, in seconds", lambda r: r.time),
    ("rule_unknowns", _COUNTER, "Number of values that were unknown when needed", lambda r: r.unknowns),
    ("rule_errors", _COUNTER, "Number of expressions that failed although their values were known", lambda r: r.errors),
    ("rule_episodes_started", _COUNTER, "Number of episodes that started", lambda r: r.started),
    ("rule_episodes_ended", _COUNTER, "Number of episodes that ended", lambda r: r.ended),
    ("rule_episodes_open", _GAUGE, "Number of open episodes", lambda r: r.open),
    ("rule_subjects_pending", _GAUGE, "Number of subjects whose `for` is running", lambda r: r.pending),
)
"""By rule."""

ACTION: tuple[tuple[str, type, str, Callable[[ActionStatus], float | None]], ...] = (
    ("action_running", _GAUGE, "Number of episodes that the action is working on", lambda a: a.running),
    ("action_done", _COUNTER, "Number of episodes that the action completed", lambda a: a.done),
    ("action_failed", _COUNTER, "Number of episodes for which the action failed", lambda a: a.failed),
    ("action_samples", _COUNTER, "Number of samples recorded or stored", lambda a: a.samples),
    ("action_bytes", _COUNTER, "Number of bytes recorded, stored or sent", lambda a: a.bytes),
    ("action_files", _COUNTER, "Number of files written", lambda a: a.files),
    ("action_missing", _COUNTER, "Number of samples, messages or similar that the action lost", lambda a: a.missing),
)
"""By rule, action and kind."""


class Metrics(Collector):
    """Metrics of the detector's latest status, and of its process."""

    def __init__(self, status: Callable[[], Status]) -> None:
        self._status = status
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def text(self) -> bytes:
        """The response to a scrape, in Prometheus' text format."""
        return generate_latest(self._registry)

    def collect(self) -> Iterable[Metric]:
        """The metrics of one status."""
        status = self._status()
        info = GaugeMetricFamily(
            f"{_PREFIX}info", "Identity of the detector; always 1", labels=("detector", "holder", "version", "clock")
        )
        info.add_metric((status.detector, status.holder, status.version, status.clock), 1)
        yield info
        yield from _families(DETECTOR, (), [((), status)])
        yield from _families(STREAM, ("stream",), [((stream.name,), stream) for stream in status.streams])
        yield _histograms(
            "stream_latency_seconds",
            "Seconds from stamp to receipt, for a few samples per second",
            "stream",
            [(stream.name, stream.latency) for stream in status.streams],
        )
        yield from _families(RULE, ("rule",), [((rule.name,), rule) for rule in status.rules])
        yield _states(status.rules)
        yield _histograms(
            "rule_latency_seconds",
            "Seconds from the receipt of the newest evaluated samples to the end of the evaluation; clock Wall only",
            "rule",
            [(rule.name, rule.latency) for rule in status.rules if rule.latency is not None],
        )
        acting = [((each.rule, each.action, each.kind), each) for each in status.actions]
        yield from _families(ACTION, ("rule", "action", "kind"), acting)
        changes = {change: getattr(status.tasks, change) for change in TASK_CHANGES}
        yield _counts("task_changes", "Number of tasks that the deploy actions changed, by change", "change", changes)
        yield _counts(
            "task_refusals",
            "Number of changes of tasks that the API server rejected, by its reason",
            "reason",
            status.tasks.refused,
        )
        losses = CounterMetricFamily(
            f"{_PREFIX}losses", "Number of items lost or unusable, by cause", labels=("cause", "stream", "rule")
        )
        for drops in status.drops:
            losses.add_metric((drops.cause, drops.stream, drops.rule), drops.count)
        yield losses


def _families(
    table: Iterable[tuple[str, type, str, Callable[[Any], float | None]]],
    labels: tuple[str, ...],
    items: Sequence[tuple[tuple[str, ...], Any]],
) -> Iterator[Metric]:
    for name, kind, text, value_of in table:
        family: GaugeMetricFamily | CounterMetricFamily = kind(f"{_PREFIX}{name}", text, labels=labels)
        for values, item in items:
            value = value_of(item)
            if value is not None:
                family.add_metric(values, float(value))
        yield family


def _counts(name: str, text: str, label: str, counts: Mapping[str, int]) -> Metric:
    family = CounterMetricFamily(f"{_PREFIX}{name}", text, labels=(label,))
    for value, count in counts.items():
        family.add_metric((value,), count)
    return family


def _states(rules: Iterable[RuleStatus]) -> Metric:
    family = GaugeMetricFamily(
        f"{_PREFIX}rule_state", "1 for the current state of the rule, else 0", labels=("rule", "state")
    )
    for rule in rules:
        for state in RuleState:
            family.add_metric((rule.name, state.value), float(rule.state is state))
    return family


def _histograms(name: str, text: str, label: str, items: Iterable[tuple[str, Histogram]]) -> Metric:
    family = HistogramMetricFamily(f"{_PREFIX}{name}", text, labels=(label,))
    for value, histogram in items:
        buckets, seen = [], 0
        for bound, count in zip((*map(str, histogram.bounds), "+Inf"), histogram.counts, strict=True):
            seen += count
            buckets.append((bound, float(seen)))
        family.add_metric((value,), buckets, histogram.sum)
    return family
