"""Prometheus metrics of the current state, computed at each scrape: tasks, instances, queues, Leases."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator

from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from application_manager.cache.cluster_cache import INSTANCE, TASK, TEMPLATE, ClusterCache
from application_manager.core.conditions import find_raw
from application_manager.core.objects.policy import KindKey
from application_manager.measures import gauge, gauges
from wayside.api.applicationinstance import InstancePhase
from wayside.api.applicationtask import TaskPhase

NO_PHASE = "None"
"""The phase of an object that the manager has not processed yet."""


class Overview(Collector):
    """Gauges of the cache and the queues. `queues` yields name, keys waiting for a worker, keys waiting for a time."""

    def __init__(self, cache: ClusterCache, queues: Callable[[], Iterable[tuple[str, int, int]]]) -> None:
        self._cache = cache
        self._queues = queues

    def collect(self) -> Iterator[Metric]:
        """The current metrics."""
        yield self._phases("tasks", "ApplicationTasks by phase", TASK, TaskPhase)
        yield self._phases("instances", "ApplicationInstances by phase", INSTANCE, InstancePhase)
        statuses = (entry.raw.get("status") or {} for _, entry in self._cache.store.all(TEMPLATE))
        accepted = Counter(find_raw(each, "Accepted").get("status", "Unknown") for each in statuses)
        by_status = [(each, accepted[each]) for each in ("True", "False", "Unknown")]
        yield gauges(
            "templates", "ApplicationTemplates by the status of their condition Accepted", "accepted", by_status
        )
        queues = list(self._queues())
        depth = [(name, waiting) for name, waiting, _ in queues]
        yield gauges("queue_depth", "Keys that wait for a worker", "queue", depth)
        later = [(name, timed) for name, _, timed in queues]
        yield gauges("queue_later", "Keys that wait for a time or a retry", "queue", later)
        views = [self._cache.leases.view(key) for key in self._cache.claims.holders()]
        overdue = sum(view.unchanged >= view.duration for view in views)
        states = [("renewed", len(views) - overdue), ("overdue", overdue)]
        yield gauges("leases", "Holders of demands by the state of their Lease", "state", states)
        shed = len(self._cache.store.shed)
        yield gauge("tasks_shed", "ApplicationTasks that wait because memory is short", shed)
        yielded = self._cache.overlap.count
        yield gauge("namespaces_yielded", "Namespaces in which an older manager is active", yielded)
        yield gauge("api_reached", "1 while the API server responds", self._cache.healthy.reached)

    def _phases(self, name: str, text: str, kind: KindKey, phases: Iterable[str]) -> Metric:
        stored = (entry.raw.get("status") or {} for _, entry in self._cache.store.all(kind))
        found = Counter(each.get("phase") or NO_PHASE for each in stored)
        return gauges(name, text, "phase", [(each, found[each]) for each in (*phases, NO_PHASE)])
