"""A status as Prometheus metrics. Labels are streams, rules and causes, never clients: there may be too many."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from detector.status.model import ActionStatus, Histogram, RuleState, RuleStatus, Status, StreamStatus

_PREFIX = "wayside_detector_"

DETECTOR: tuple[tuple[str, type, str, Callable[[Status], float | None]], ...] = (
    ("connected", GaugeMetricFamily, "1 while a Zenoh router, peer or client is connected", lambda s: s.connected),
    ("start_time_seconds", GaugeMetricFamily, "When the detector started, since the epoch", lambda s: s.started),
    ("status_time_seconds", GaugeMetricFamily, "When these numbers were taken, since the epoch", lambda s: s.taken),
    ("evaluated_time_seconds", GaugeMetricFamily, "Up to here all ticks have run, on the time axis", lambda s: s.now),
    ("generation", GaugeMetricFamily, "Of the Detector that is followed; 0 from a file", lambda s: s.generation),
    ("clients", GaugeMetricFamily, "Clients that are known", lambda s: s.client_count),
    ("gaps", CounterMetricFamily, "Times at which ticks were not made up for", lambda s: s.gaps),
    ("buffer_bytes", GaugeMetricFamily, "Held in the buffer, overhead included", lambda s: s.buffered_bytes),
    ("buffer_limit_bytes", GaugeMetricFamily, "The cap over all streams", lambda s: s.maximum_bytes),
    ("demands", GaugeMetricFamily, "Tasks that are demanded now", lambda s: s.demand_count),
    ("clients_missing", GaugeMetricFamily, "Expected clients that send nothing", lambda s: s.missing_count),
    (
        "certificate_expiry_time_seconds",
        GaugeMetricFamily,
        "When the certificate in use expires, since the epoch; without one, not there",
        lambda s: s.certificate.expires,
    ),
    (
        "certificate_refused",
        GaugeMetricFamily,
        "1 while the files' new certificates are not used, being of no use",
        lambda s: bool(s.certificate.problem),
    ),
    ("certificate_renewals", CounterMetricFamily, "Times new ones were taken", lambda s: s.certificate.renewals),
)
"""Without labels: name, kind, what it tells, and its value; None: not there."""

STREAM: tuple[tuple[str, type, str, Callable[[StreamStatus], float | None]], ...] = (
    ("stream_samples", CounterMetricFamily, "Samples taken into the buffer", lambda s: s.samples),
    ("stream_samples_per_second", GaugeMetricFamily, "Over the last ten seconds or so", lambda s: s.rate),
    ("stream_clients", GaugeMetricFamily, "Clients of which something is buffered", lambda s: s.clients),
    ("stream_age_seconds", GaugeMetricFamily, "Since the newest sample, on the time axis", lambda s: s.age),
    ("stream_buffered_samples", GaugeMetricFamily, "Samples in the buffer", lambda s: s.buffered_samples),
    ("stream_buffered_bytes", GaugeMetricFamily, "Their bytes, overhead included", lambda s: s.buffered_bytes),
)
"""By stream."""

RULE: tuple[tuple[str, type, str, Callable[[RuleStatus], float | None]], ...] = (
    ("rule_evaluations", CounterMetricFamily, "Subjects looked at", lambda r: r.evaluations),
    ("rule_ticks", CounterMetricFamily, "Times at which the rule was evaluated, for all subjects", lambda r: r.ticks),
    ("rule_evaluation_seconds", CounterMetricFamily, "Spent on evaluating", lambda r: r.time),
    ("rule_unknowns", CounterMetricFamily, "Values that were not there when needed", lambda r: r.unknowns),
    ("rule_errors", CounterMetricFamily, "Expressions that failed on values that were there", lambda r: r.errors),
    ("rule_episodes_started", CounterMetricFamily, "Episodes that started", lambda r: r.started),
    ("rule_episodes_ended", CounterMetricFamily, "Episodes that ended", lambda r: r.ended),
    ("rule_episodes_open", GaugeMetricFamily, "Episodes that are open now", lambda r: r.open),
    (
        "rule_subjects_pending",
        GaugeMetricFamily,
        "Subjects whose `for` has begun",
        lambda r: r.pending,
    ),
)
"""By rule."""

ACTION: tuple[tuple[str, type, str, Callable[[ActionStatus], float | None]], ...] = (
    ("action_running", GaugeMetricFamily, "Episodes that an action works on", lambda a: a.running),
    ("action_done", CounterMetricFamily, "Episodes that an action has done its work for", lambda a: a.done),
    ("action_failed", CounterMetricFamily, "Episodes that an action failed with", lambda a: a.failed),
    ("action_samples", CounterMetricFamily, "Samples that are recorded or stored", lambda a: a.samples),
    ("action_bytes", CounterMetricFamily, "Bytes that are recorded, stored or sent", lambda a: a.bytes),
    ("action_files", CounterMetricFamily, "Files that were written", lambda a: a.files),
    ("action_missing", CounterMetricFamily, "Samples, messages or the like lost on the way", lambda a: a.missing),
)
"""By rule, action and kind."""

Family = GaugeMetricFamily | CounterMetricFamily


class Metrics(Collector):
    """Metrics of the detector's newest status, and of its process."""

    def __init__(self, status: Callable[[], Status]) -> None:
        self._status = status
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def text(self) -> bytes:
        """What a scrape gets, in Prometheus' text format."""
        return generate_latest(self._registry)

    def collect(self) -> Iterable[Metric]:
        """The metrics of one status."""
        status = self._status()
        info = GaugeMetricFamily(
            f"{_PREFIX}info", "Which detector this is; always 1", labels=("detector", "holder", "version", "clock")
        )
        info.add_metric((status.detector, status.holder, status.version, status.clock), 1)
        yield info
        yield from _families(DETECTOR, (), [((), status)])
        yield from _families(STREAM, ("stream",), [((stream.name,), stream) for stream in status.streams])
        yield _histograms(
            "stream_latency_seconds",
            "From stamp to receipt, of some samples each second",
            "stream",
            [(stream.name, stream.latency) for stream in status.streams],
        )
        yield from _families(RULE, ("rule",), [((rule.name,), rule) for rule in status.rules])
        yield _states(status.rules)
        yield _histograms(
            "rule_latency_seconds",
            "From the receipt of what an evaluation saw to its end, clock Wall only",
            "rule",
            [(rule.name, rule.latency) for rule in status.rules if rule.latency is not None],
        )
        acting = [((each.rule, each.action, each.kind), each) for each in status.actions]
        yield from _families(ACTION, ("rule", "action", "kind"), acting)
        losses = CounterMetricFamily(
            f"{_PREFIX}losses", "What was lost or could not be used, by cause", labels=("cause", "stream", "rule")
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
        family: Family = kind(f"{_PREFIX}{name}", text, labels=labels)
        for values, item in items:
            value = value_of(item)
            if value is not None:
                family.add_metric(values, float(value))
        yield family


def _states(rules: Iterable[RuleStatus]) -> Metric:
    family = GaugeMetricFamily(f"{_PREFIX}rule_state", "1 for the state that the rule is in", labels=("rule", "state"))
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
