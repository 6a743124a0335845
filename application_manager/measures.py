"""Counters and timers of the manager, as Prometheus metrics. docs/manager.md describes each.

Labels are queues, reasons, phases and codes, never names of objects: there may be too many.
"""

from __future__ import annotations

import time
from collections.abc import Iterable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric

PREFIX = "wayside_manager_"

_SERVICE = (
    0.05,
    0.1,
    0.2,
    0.5,
    1,
    2,
    5,
    10,
    20,
    60,
    120,
    300,
    600,
)  # s from an event until its task is applied or ready
_WORK = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 15)  # s of a request or a reconciliation


def gauge(name: str, text: str, value: float) -> Metric:
    """The current value of a number, for a collector."""
    return GaugeMetricFamily(f"{PREFIX}{name}", text, value)


def gauges(name: str, text: str, label: str, values: Iterable[tuple[str, float]]) -> Metric:
    """The current value of a number for each value of a label."""
    family = GaugeMetricFamily(f"{PREFIX}{name}", text, labels=(label,))
    for of, value in values:
        family.add_metric((of,), value)
    return family


class Measures:
    """The counters and histograms of a manager; only its event loop's thread writes them.

    Attributes:
        registry: also for the collectors that read the cache.
        last_resync: the end of the last resync, successful or not, on the monotonic clock; initially the start.
    """

    def __init__(self) -> None:
        self.registry = CollectorRegistry(auto_describe=False)
        self.last_resync = time.monotonic()
        self._applied = self._histogram(
            "event_to_applied_seconds", "Time from the start of an event until its task is Applied", _SERVICE
        )
        self._ready = self._histogram(
            "event_to_ready_seconds", "Time from the start of an event until its task is Ready", _SERVICE
        )
        self._reconciled = self._histogram("reconcile_seconds", "Time that reconciling one object took", _WORK, "queue")
        self._failures = self._counter("reconcile_failures", "Reconciliations that failed and are retried", "queue")
        self._refusals = self._counter("refusals", "Refusals of tasks; each new reason counts again", "reason")
        self._requests = self._histogram("api_request_seconds", "Response time of the API server", _WORK, "method")
        self._errors = self._counter(
            "api_errors", "Requests that the API server refused, or did not respond to", "code"
        )
        self._events = self._counter("kubernetes_events", "Kubernetes Events that were posted", "reason")
        self._unposted = self._counter("kubernetes_events_dropped", "Kubernetes Events that were not posted", "cause")
        self._reviews = self._counter("reviews", "Admission reviews of the API server", "kind", "answer")
        self._jobs = self._histogram("job_seconds", "Time that a worker process took for a job", _WORK)
        self._exceeded = self._counter("jobs_exceeded", "Jobs that exceeded their limits")
        self._resynced = Gauge(
            f"{PREFIX}resync_time_seconds",
            "Time of the last resync, in seconds since the epoch",
            registry=self.registry,
        )
        self._active = Gauge(f"{PREFIX}active", "1 for the active manager, 0 for a standby", registry=self.registry)
        ProcessCollector(registry=self.registry)

    def text(self) -> bytes:
        """The response to a scrape, in Prometheus' text format."""
        return generate_latest(self.registry)

    def applied(self, seconds: float) -> None:
        """A task was applied this number of seconds after its event started, by the detector's clock."""
        self._applied.observe(max(0.0, seconds))

    def ready(self, seconds: float) -> None:
        """A task was ready this number of seconds after its event started, by the detector's clock."""
        self._ready.observe(max(0.0, seconds))

    def refused(self, reason: str) -> None:
        """A task was refused."""
        self._refusals.labels(reason).inc()

    def reconciled(self, queue: str, seconds: float, *, failed: bool) -> None:
        """A queue finished its work on one key."""
        self._reconciled.labels(queue).observe(seconds)
        if failed:
            self._failures.labels(queue).inc()

    def unhandled(self) -> None:
        """An event of a watch could not be handled; the next resync retries it."""
        self._failures.labels("watch").inc()

    def requested(self, method: str, seconds: float, code: str) -> None:
        """The API server responded with an HTTP status; `none`: it did not respond."""
        self._requests.labels(method).observe(seconds)
        if not code.startswith(("2", "3")):
            self._errors.labels(code).inc()

    def posted(self, reason: str) -> None:
        """A Kubernetes Event was posted."""
        self._events.labels(reason).inc()

    def unposted(self, cause: str) -> None:
        """A Kubernetes Event was not posted: `full`, `limited` or `failed`."""
        self._unposted.labels(cause).inc()

    def reviewed(self, kind: str, answer: str) -> None:
        """A review was `allowed`, `warned` about or `refused`; or it `failed`, then without a kind."""
        self._reviews.labels(kind, answer).inc()

    def job_done(self, seconds: float) -> None:
        """A worker process did a job."""
        self._jobs.observe(seconds)

    def job_exceeded(self) -> None:
        """A job was stopped, and its worker process with it."""
        self._exceeded.inc()

    def active(self, active: bool) -> None:
        """Whether this manager is the active one."""
        self._active.set(active)

    def resynced(self, *, succeeded: bool) -> None:
        """A resync ended."""
        self.last_resync = time.monotonic()
        if succeeded:
            self._resynced.set(time.time())

    def _histogram(self, name: str, text: str, buckets: tuple[float, ...], *labels: str) -> Histogram:
        return Histogram(f"{PREFIX}{name}", text, labels, buckets=buckets, registry=self.registry)

    def _counter(self, name: str, text: str, *labels: str) -> Counter:
        return Counter(f"{PREFIX}{name}", text, labels, registry=self.registry)
