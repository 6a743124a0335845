"""Prometheus metrics of the current state, computed at each scrape: tasks, instances, queues, Leases."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from application_manager.cache.cluster_cache import INSTANCE, TASK, TEMPLATE, ClusterCache
from application_manager.measures import PREFIX
from wayside.api.applicationinstance import InstancePhase
from wayside.api.applicationtask import TaskPhase

NO_PHASE = "None"
"""The phase of what the manager has not looked at yet."""


class Overview(Collector):
    """Gauges over the cache.

    Args of the constructor:
        queues: by name, how many keys wait for a worker, and how many for their time.
    """

    def __init__(self, cache: ClusterCache, queues: Callable[[], Iterable[tuple[str, int, int]]]) -> None:
        self._cache = cache
        self._queues = queues

    def collect(self) -> Iterator[Metric]:
        """The metrics as of now."""
        yield self._phases("tasks", "ApplicationTasks by phase", TASK, [each.value for each in TaskPhase])
        yield self._phases(
            "instances", "ApplicationInstances by phase", INSTANCE, [each.value for each in InstancePhase]
        )
        yield self._templates()
        depth = GaugeMetricFamily(f"{PREFIX}queue_depth", "Keys that wait for a worker", labels=("queue",))
        later = GaugeMetricFamily(f"{PREFIX}queue_later", "Keys that wait for a time or a retry", labels=("queue",))
        for name, waiting, timed in self._queues():
            depth.add_metric((name,), waiting)
            later.add_metric((name,), timed)
        yield from (depth, later)
        yield self._leases()
        shed = GaugeMetricFamily(f"{PREFIX}tasks_shed", "ApplicationTasks that wait because memory is short")
        shed.add_metric((), len(self._cache.store.shed))
        yield shed
        yielded = GaugeMetricFamily(f"{PREFIX}namespaces_yielded", "Namespaces in which an older manager is active")
        yielded.add_metric((), self._cache.overlap.count)
        yield yielded
        reached = GaugeMetricFamily(f"{PREFIX}api_reached", "1 while the API server responds")
        reached.add_metric((), float(self._cache.healthy.reached))
        yield reached

    def _phases(self, name: str, text: str, kind: tuple[str, str], phases: Sequence[str]) -> Metric:
        family = GaugeMetricFamily(f"{PREFIX}{name}", text, labels=("phase",))
        found = Counter(
            (entry.raw.get("status") or {}).get("phase") or NO_PHASE for _, entry in self._cache.store.all(kind)
        )
        for phase in (*phases, NO_PHASE):
            family.add_metric((phase,), found[phase])
        return family

    def _templates(self) -> Metric:
        family = GaugeMetricFamily(f"{PREFIX}templates", "ApplicationTemplates by Accepted", labels=("accepted",))
        found = Counter(_accepted(entry.raw) for _, entry in self._cache.store.all(TEMPLATE))
        for status in ("True", "False", "Unknown"):
            family.add_metric((status,), found[status])
        return family

    def _leases(self) -> Metric:
        family = GaugeMetricFamily(
            f"{PREFIX}leases", "Holders of demands by the state of their Lease", labels=("state",)
        )
        at = self._cache.healthy.elapsed
        views = [self._cache.leases.view(key, at) for key in self._cache.claims.holders()]
        overdue = sum(view.unchanged >= view.duration for view in views)
        family.add_metric(("renewed",), len(views) - overdue)
        family.add_metric(("overdue",), overdue)
        return family


def _accepted(raw: dict[str, object]) -> str:
    status = raw.get("status")
    conditions = status.get("conditions") if isinstance(status, dict) else None
    return next((str(each["status"]) for each in conditions or () if each["type"] == "Accepted"), "Unknown")
