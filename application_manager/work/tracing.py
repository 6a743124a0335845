"""The spans of the work for tasks that have a trace, if tracing is on (see `wayside.process.tracing`).

A task that an instance serves for the first time has the span `reconcile` with its child `apply`, and `ready` once the
workloads are ready. All are in the task's own trace; if the instance serves several tasks, `reconcile` is linked to the
others.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from prometheus_client.core import CounterMetricFamily, Metric
from prometheus_client.registry import Collector

from application_manager.cache.cluster_cache import ClusterCache, WorkRecord
from application_manager.core.claims.operations import VerdictKind
from application_manager.core.conditions import changed, find, holds
from application_manager.core.objects.policy import Name
from application_manager.measures import PREFIX
from wayside.api import ApplicationTask
from wayside.api.applicationtask import TRACEPARENT_ANNOTATION, ApplicationTaskStatus
from wayside.process.tracecontext import Attribute, Span, TraceContext, parse_traceparent
from wayside.times import parse_seconds

if TYPE_CHECKING:
    from wayside.process.spans import Tracing

_REMEMBERED = 10_000
"""Tasks that are not ready yet; beyond it, the oldest are forgotten, and the parent of their `ready` is the task."""
_LINKS = 20
"""The maximum number of links of a `reconcile` to other tasks, in their order."""

log = logging.getLogger(__name__)


@dataclass
class _Known:
    """A task that is not ready yet: its `reconcile`, the time at which it was applied (ns), and its last failure."""

    reconcile: TraceContext | None = None
    applied: int = 0
    failure: str = ""
    unserved: bool = False  # it ended before a span of an instance's work was emitted


class TaskTraces:
    """Emits the spans of tasks. Only the event loop's thread uses it."""

    def __init__(self, tracing: Tracing, cache: ClusterCache) -> None:
        self.tracing = tracing
        self._cache = cache
        self._known: OrderedDict[str, _Known] = OrderedDict()
        self._reported = False

    async def reconciling(self, name: Name, work: Callable[[Name], Awaitable[None]]) -> None:
        """Do the work on an instance, and emit its spans for tasks."""
        began, before = time.time_ns(), self._cache.records.get(name)
        try:
            await work(name)
        finally:
            record = self._cache.records.get(name)
            if record is not None and record is not before and not record.decision.withheld:
                self._reconciled(name, began, record)

    def status_written(self, task: ApplicationTask, old: ApplicationTaskStatus, new: ApplicationTaskStatus) -> None:
        """A task's status was written: emit the spans of its progress."""
        context = _context(task)
        if context is None:
            return
        about = {**_about(task), "wayside.instance": new.instance_name or ""}
        now = time.time_ns()
        for each in changed(old.conditions, new.conditions):
            if each.type == "Accepted" and each.status == "False":
                word = str(new.phase.value).lower() if new.phase else "refused"
                self._emit(
                    Span(word, now, now, parent=context, attributes=about, error=f"{each.reason}: {each.message}")
                )
            elif each.type == "Finished" and each.status == "True":
                self._finished(task, context, old, new, now)
        if new.ready_time is not None and old.ready_time is None:
            self._ready(task, context, new, now, None)

    def _finished(
        self,
        task: ApplicationTask,
        context: TraceContext,
        old: ApplicationTaskStatus,
        new: ApplicationTaskStatus,
        now: int,
    ) -> None:
        """The task's demand is over: emit a failed `ready` if an instance served it and was never ready for it.

        A task may end before its status names an instance; then only `reconcile` shows that one served it.
        """
        known = self._known.get(task.metadata.uid)
        applied, ready = find(old.conditions, "Applied"), find(old.conditions, "Ready")
        if old.ready_time is not None:
            self._known.pop(task.metadata.uid, None)
        elif applied is not None and ready is not None:
            self._ready(task, context, new, now, f"{ready.reason}: {ready.message}")
        elif known is not None and known.reconcile is not None:
            self._ready(task, context, new, now, "NotReady: the task ended before its instance was ready")
        else:
            self._remembered(task.metadata.uid).unserved = True

    def _reconciled(self, name: Name, began: int, record: WorkRecord) -> None:
        """Emit `reconcile` and `apply` of each task that the instance serves."""
        ended = time.time_ns()
        served: dict[str, tuple[ApplicationTask, TraceContext]] = {}
        for task_name, verdict in record.decision.verdicts.items():
            task = self._cache.task((name[0], task_name))
            if verdict.kind is VerdictKind.COUNTS and task is not None and (context := _context(task)) is not None:
                served[task_name] = (task, context)
        for task, context in served.values():
            # Unless it was applied before, or this failure was emitted.
            if task.status is not None and task.status.applied_time is not None:
                continue
            known = self._remembered(task.metadata.uid)
            state, took = record.applied.state, record.applied.took
            failure = "" if state.holds else f"{state.reason}: {state.message}"
            if known.applied or (failure and failure == known.failure):
                continue
            about = {**_about(task), "wayside.instance": name[1]}
            known.failure = failure
            known.reconcile = self._emit(
                Span(
                    f"reconcile {record.decision.template}",
                    began,
                    ended,
                    parent=context,
                    attributes={**about, "wayside.demands": len(served)},
                    links=[other for each, (_, other) in served.items() if each != task.name][:_LINKS],
                    error=failure or None,
                )
            )
            if took is not None:
                self._emit(Span("apply", *took, parent=known.reconcile, attributes=about, error=failure or None))
            if state.holds:
                known.applied = ended
            if task.status is not None and holds(task.status.conditions, "Finished"):  # it ended during this work
                if known.unserved:
                    self._finished(task, context, task.status, task.status, ended)
                self._known.pop(task.metadata.uid, None)

    def _ready(
        self, task: ApplicationTask, context: TraceContext, status: ApplicationTaskStatus, now: int, failure: str | None
    ) -> None:
        known = self._known.pop(task.metadata.uid, None)
        start = round(parse_seconds(status.applied_time) * 1e9) if status.applied_time is not None else now
        if known is not None and known.applied:
            start = known.applied
        parent = known.reconcile if known is not None and known.reconcile is not None else context
        about = {**_about(task), "wayside.instance": status.instance_name or ""}
        self._emit(Span("ready", min(start, now), now, parent=parent, attributes=about, error=failure))

    def _emit(self, span: Span) -> TraceContext:
        if self.tracing.failed and not self._reported:
            self._reported = True
            log.warning("%s does not accept spans; lost spans are counted in the metrics", self.tracing.endpoint)
        return self.tracing.emit(span)

    def _remembered(self, uid: str) -> _Known:
        known = self._known.setdefault(uid, _Known())
        while len(self._known) > _REMEMBERED:
            self._known.popitem(last=False)
        return known


class LostSpans(Collector):
    """The number of lost spans, as a Prometheus metric."""

    def __init__(self, tracing: Tracing) -> None:
        self._tracing = tracing

    def collect(self) -> Iterator[Metric]:
        """The current metric."""
        family = CounterMetricFamily(f"{PREFIX}spans_dropped", "Spans that were lost", labels=("cause",))
        family.add_metric(("full",), self._tracing.dropped)
        family.add_metric(("failed",), self._tracing.failed)
        yield family


def _context(task: ApplicationTask) -> TraceContext | None:
    """The parent span in the task; None if it has no trace, or a trace that is not recorded."""
    context = parse_traceparent(task.metadata.annotations.get(TRACEPARENT_ANNOTATION))
    return context if context is not None and context.sampled else None


def _about(task: ApplicationTask) -> dict[str, Attribute]:
    return {
        "k8s.namespace.name": task.namespace,
        "wayside.task": task.name,
        "wayside.template": task.spec.template_name,
        "wayside.operation": task.spec.operation.value,
    }
