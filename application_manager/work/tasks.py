"""Reconciles one task: writes its status, and deletes it some time after it has finished."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from application_manager.cache.cluster_cache import TASKS, TEMPLATES, ClusterCache
from application_manager.core.claims.claims import Claim, RefusalReason
from application_manager.core.claims.operations import Verdict, VerdictKind
from application_manager.core.conditions import changed
from application_manager.core.demand.demand import finished, verdict_of
from application_manager.core.objects import trimming
from application_manager.core.objects.policy import Name
from application_manager.core.statuses.status import InstanceProgress, combined_progress, finished_since, task_status
from application_manager.measures import Measures
from application_manager.work.statuses import StatusWriter
from application_manager.work.tracing import TaskTraces
from wayside.api import ApplicationTask
from wayside.api.applicationtask import ApplicationTaskStatus
from wayside.api.documents import parse_object
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Object
from wayside.times import parse_seconds

_SHED = Verdict(
    VerdictKind.WAITING,
    "ManagerOverloaded",
    "the application manager is near its memory limit and accepts no new tasks: this task is accepted once memory is "
    "free; end tasks, or raise the limit",
)
_OWN_CONDITIONS = ("Accepted", "Finished")  # the instance has Events about the others

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TaskWork:
    """Writes the statuses of tasks, deletes them `ttl` seconds after they have finished, and measures their times.

    `enqueue_at` enqueues a task at a time, in seconds since 1970.
    """

    cache: ClusterCache
    client: Client
    statuses: StatusWriter
    ttl: float
    enqueue_at: Callable[[Name, float], None]
    observe: Callable[[Object], None]
    measures: Measures
    traces: TaskTraces | None = None

    async def reconcile(self, name: Name) -> None:
        """Write the task's status if it differs; delete a task that has been finished for `ttl` seconds.

        Raises RequestError for a temporary error.
        """
        if name in self.cache.store.shed:
            await self._write_shed(name)
            return
        task = self.cache.task(name)
        known = self._verdict(name, task) if task is not None else None
        if task is None or known is None or task.metadata.deletion_timestamp is not None:
            return
        verdict, progress, generation = known
        if verdict.reason == RefusalReason.TEMPLATE_NOT_FOUND and await self._has_template(
            name[0], task.spec.template_name
        ):
            return  # the watch of templates is behind that of tasks; the template's event enqueues the task again
        await self._write(name, task, verdict, progress, generation)

    async def _write_shed(self, name: Name) -> None:
        """Write that a task is not accepted for lack of memory; it is read only for this."""
        raw = await self.client.get(TASKS, *name)
        try:
            task = parse_object(trimming.own(raw)) if raw is not None else None
        except ValueError:
            return
        if isinstance(task, ApplicationTask):
            await self._write(name, task, finished(task) or _SHED, None, task.metadata.generation)

    async def _write(
        self, name: Name, task: ApplicationTask, verdict: Verdict, progress: InstanceProgress | None, generation: int
    ) -> None:
        now = time.time()
        old = task.status or ApplicationTaskStatus()
        new = task_status(task, verdict, progress, now, generation)
        try:
            if not await self.statuses.write(TASKS, task, task.status, new, now, _OWN_CONDITIONS):
                return
            self._measure(task, old, new, now)
            if self.traces is not None:
                self.traces.status_written(task, old, new)
            if verdict.kind is VerdictKind.FINISHED:
                await self._expire(name, task.model_copy(update={"status": new}))
        except ApiError as error:
            if not error.terminating:
                raise

    def _measure(
        self, task: ApplicationTask, old: ApplicationTaskStatus, new: ApplicationTaskStatus, now: float
    ) -> None:
        """Measure the task's progress, once for each change."""
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
        found = await self.client.get(TEMPLATES, namespace, template)
        if found is not None:
            self.observe(found)
        return found is not None

    def _verdict(self, name: Name, task: ApplicationTask) -> tuple[Verdict, InstanceProgress | None, int] | None:
        """The task's verdict, and the generation on which it is based; None if its instance was not processed yet."""
        verdict = self.cache.claims.verdict(name)
        if verdict is not None:
            return verdict, None, task.metadata.generation
        claimed = self.cache.claims.claim(name)
        if claimed is None:
            return None
        known = self.cache.last_decisions
        served = {each[1]: known[each] for each in self._decided(name[0], claimed) if each in known}
        found = verdict_of(claimed, {of: each.decision for of, each in served.items()}, served)
        if found is None:
            return None
        parts = [served[each].progress for each in found.serving]
        return found.verdict, combined_progress(parts) if parts else None, found.generation

    def _decided(self, namespace: str, claimed: Claim) -> Iterator[Name]:
        """The instances whose decisions determine the verdict of a claim."""
        yield from self.cache.expand((namespace, claimed.instance))
        served = self.cache.last_decisions.get((namespace, claimed.instance))
        fallback = served.decision.fallback if served is not None else None
        instead = fallback.instance_of(claimed.task.name) if fallback is not None else None
        if instead is not None:
            yield namespace, instead

    async def _expire(self, name: Name, task: ApplicationTask) -> None:
        since = finished_since(task)
        if since is None:
            return
        if time.time() < since + self.ttl:
            self.enqueue_at(name, since + self.ttl)
            return
        await self.client.delete(TASKS, name[0], name[1], task.metadata.uid)
        log.info("task %s/%s: deleted %g s after it finished", *name, self.ttl)
