"""Reconciling one task: its status, and its deletion some time after it has finished."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from application_manager.cache.cluster_cache import ClusterCache
from application_manager.cluster.client import Client, Object, Resource
from application_manager.cluster.errors import ApiError
from application_manager.core.claims.claims import Claim, Refused, template_of_all
from application_manager.core.claims.operations import Standing, Verdict, gathered
from application_manager.core.conditions import changed
from application_manager.core.demand.demand import finished
from application_manager.core.demand.fallback import FALLEN_BACK, turned
from application_manager.core.objects import trimming
from application_manager.core.objects.policy import Name
from application_manager.core.statuses.status import Service, finished_since, task_status, together
from application_manager.measures import Measures
from application_manager.observability.tracing import TaskTraces
from application_manager.work.statuses import StatusWriter
from wayside.api import ApplicationTask
from wayside.api.applicationtask import ApplicationTaskStatus
from wayside.api.documents import parse_object
from wayside.times import parse_seconds

_SHED = Verdict(
    Standing.WAITING,
    "ManagerOverloaded",
    "the application manager is near its memory limit and accepts no new tasks: it accepts this one once memory is "
    "free; end tasks, or raise the limit",
)
_OWN_CONDITIONS = ("Accepted", "Finished")  # the others are the instance's, which has Events about them

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TaskWork:
    """Writes the statuses of tasks.

    Attributes:
        tasks: where ApplicationTasks live.
        templates: where ApplicationTemplates live.
        ttl: seconds that a finished task is kept.
        again: enqueues a task at a time, in seconds since 1970.
        observe: takes an object that was read.
        measures: counts refusals, and measures the times from event to service.
        traces: emits spans, where traces are on.
    """

    cache: ClusterCache
    client: Client
    statuses: StatusWriter
    tasks: Resource
    templates: Resource
    ttl: float
    again: Callable[[Name, float], None]
    observe: Callable[[Object], None]
    measures: Measures
    traces: TaskTraces | None = None

    async def reconcile(self, name: Name) -> None:
        """Write the task's status if it differs; delete the task when its time has come.

        Raises ApiError or Unreachable for what may pass; the caller tries again.
        """
        if name in self.cache.store.shed:
            await self._write_shed(name)
            return
        task = self.cache.task(name)
        known = self._verdict(name)
        if task is None or known is None or task.metadata.deletion_timestamp is not None:
            return
        verdict, service = known
        if verdict.reason == Refused.TEMPLATE_NOT_FOUND and await self._has_template(name[0], task.spec.template_name):
            return  # the watch of templates was behind that of tasks; the template's event enqueues the task again
        await self._write(name, task, verdict, service)

    async def _write_shed(self, name: Name) -> None:
        """Write that a task is not taken in; it is read for that alone."""
        raw = await self.client.get(self.tasks, *name)
        try:
            task = parse_object(trimming.own(raw)) if raw is not None else None
        except ValueError:
            return
        if isinstance(task, ApplicationTask):
            await self._write(name, task, finished(task) or _SHED, None)

    async def _write(self, name: Name, task: ApplicationTask, verdict: Verdict, service: Service | None) -> None:
        now = time.time()
        old = task.status or ApplicationTaskStatus()
        new = task_status(task, verdict, service, now)
        try:
            if not await self.statuses.write(self.tasks, task, task.status, new, now, _OWN_CONDITIONS):
                return
            self._measure(task, old, new, now)
            if self.traces is not None:
                self.traces.status_written(task, old, new)
            if verdict.standing is Standing.FINISHED:
                await self._expire(name)
        except ApiError as error:
            if not error.terminating:
                raise

    def _measure(
        self, task: ApplicationTask, old: ApplicationTaskStatus, new: ApplicationTaskStatus, now: float
    ) -> None:
        """Measure what became of the task, once for each change."""
        for each in changed(old.conditions, new.conditions):
            if each.type == "Accepted" and each.status == "False":
                self.measures.refused(each.reason)
        if task.spec.event is None:
            return
        since_start = now - parse_seconds(task.spec.event.start_time)
        if new.applied_time is not None and old.applied_time is None:
            self.measures.applied(since_start)
        if new.ready_time is not None and old.ready_time is None:
            self.measures.ready(since_start)

    async def _has_template(self, namespace: str, template: str) -> bool:
        found = await self.client.get(self.templates, namespace, template)
        if found is not None:
            self.observe(found)
        return found is not None

    def _verdict(self, name: Name) -> tuple[Verdict, Service | None] | None:
        """What became of the task; None where its instance was not looked at yet."""
        verdict = self.cache.claims.verdict(name)
        if verdict is not None:
            return verdict, None
        claimed = self.cache.claims.claim(name)
        if claimed is not None and (template := template_of_all(claimed.instance)) is not None:
            return self._of_all(name, claimed, (name[0], template))
        served = self.cache.served.get((name[0], claimed.instance)) if claimed is not None else None
        if served is None or name[1] not in served.verdicts:
            return None
        instead = served.fallback.instance_of(name[1]) if served.fallback is not None else None
        other = self.cache.served.get((name[0], instead)) if instead is not None else None
        others = other.verdicts if other is not None else {}
        verdict = turned(served.verdicts[name[1]], name[1], served.fallback, others)
        serves = other if other is not None and verdict.reason == FALLEN_BACK else served
        return verdict, serves.service

    def _of_all(self, name: Name, claimed: Claim, template: Name) -> tuple[Verdict, Service | None] | None:
        """What became of a task that means all instances of a template, from the verdict of each."""
        alone = self.cache.served.get((name[0], claimed.instance))
        if alone is None or name[1] not in alone.verdicts:
            return None
        each = {
            instance[1]: served
            for instance in self.cache.meant((name[0], claimed.instance))
            if (served := self.cache.served.get(instance)) is not None and served is not alone
        }
        parts = {instance: served.verdicts[name[1]] for instance, served in each.items() if name[1] in served.verdicts}
        verdict = gathered(claimed, parts, alone.verdicts[name[1]])
        serving = [each[instance].service for instance, part in parts.items() if part.standing is Standing.COUNTS]
        return verdict, together(serving) if serving else None

    async def _expire(self, name: Name) -> None:
        task = self.cache.task(name)
        since = finished_since(task) if task is not None else None
        if task is None or since is None:
            return
        if time.time() < since + self.ttl:
            self.again(name, since + self.ttl)
            return
        await self.client.delete(self.tasks, name[0], name[1], task.metadata.uid)
        log.info("task %s/%s: deleted %g s after it finished", *name, self.ttl)
