"""Wires the queues to their work.

Events come in through the router, which enqueues keys. The work of a queue writes, notes the result in the cache, and
enqueues the objects that depend on it.
"""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING

from application_manager.cache.cluster_cache import DETECTOR, INSTANCE, ClusterCache
from application_manager.cache.detector_index import DetectorIndex
from application_manager.charts.chartcache import ChartCache
from application_manager.charts.chartrenderer import ChartRenderer
from application_manager.cluster.polls import FailedPodsPoll, NodePoll
from application_manager.core.demand.decisions import Decision
from application_manager.core.objects.policy import KindKey, Name
from application_manager.measures import Measures
from application_manager.observability.overview import Overview
from application_manager.running.headroom import Headroom
from application_manager.running.options import Options
from application_manager.watching.router import Router
from application_manager.work.applying import Applier
from application_manager.work.configurations import ConfigurationWork
from application_manager.work.detectors import DetectorWork
from application_manager.work.instances import InstanceWork
from application_manager.work.instancestatus import InstanceStatusWork
from application_manager.work.publishing import Publisher
from application_manager.work.recorder import Recorder
from application_manager.work.rendering import Renderings
from application_manager.work.scaling import WorkloadScaler
from application_manager.work.statuses import StatusWriter
from application_manager.work.tasks import TaskWork
from application_manager.work.tracing import LostSpans, TaskTraces
from application_manager.work.validating import RuleKey, RuleWork, TemplateWork
from application_manager.workers.answers import AnswerCache
from application_manager.workers.claiming import evaluate_claim
from application_manager.workers.pool import Pool
from wayside.kubernetes.client import Client
from wayside.kubernetes.resources import Resource
from wayside.kubernetes.workqueue import Key, WorkQueue

if TYPE_CHECKING:
    from wayside.process.spans import Tracing

_VALIDATION_PAUSE = 0.3  # s from a change of a template, rule or detector to its status: it combines several changes
_INSTANCE_WORKERS = 16
_INSTANCE_SHARE = 6  # of these for one namespace: more concurrent requests slow down all namespaces
_CONFIGURATION_WORKERS = 4
_VALIDATION_WORKERS = 4  # one per namespace: they mostly wait for worker processes
_STATUS_WORKERS = 4
_STATUS_SHARE = 2  # few: work on instances comes before their statuses


class Assembly:
    """All queues of a manager, and their shared state.

    Attributes:
        detector_index: the state of the Detectors that the manager runs; `detectors`: their queue.
        pool: evaluates users' expressions.
        queues: all of them.
    """

    def __init__(
        self,
        client: Client,
        options: Options,
        resources: dict[KindKey, Resource],
        measures: Measures,
        traced: Tracing | None,
    ) -> None:
        self.client, self.options, self.resources, self.measures = client, options, resources, measures
        headroom = Headroom(options.memory_limit)
        measures.registry.register(headroom)
        self.cache = ClusterCache(options.policy, options.max_instances, headroom.tight, options.tasks)
        self._traces = None if traced is None else TaskTraces(traced, self.cache)
        if traced is not None:
            measures.registry.register(LostSpans(traced))
        self.recorder = Recorder(client, measures)
        applier = self.applier = Applier(client, self.cache.store, resources)
        instances: WorkQueue[Name] = WorkQueue(
            "instance",
            self._where_active(self._reconcile_instance),
            _INSTANCE_WORKERS,
            measure=measures.reconciled,
            share=_INSTANCE_SHARE,
        )

        def queue(
            name: str, work: Callable[[Key], Awaitable[None]], workers: int, share: int | None = None
        ) -> WorkQueue[Key]:
            return WorkQueue(name, work, workers, instances, measures.reconciled, share)

        def statuses_of(name: str, reconcile: Callable[[Name], Awaitable[None]]) -> WorkQueue[Name]:
            return queue(name, self._where_active(reconcile), _STATUS_WORKERS, _STATUS_SHARE)

        # The reconcilers are created below, because they need the queues.
        self._instances = instances
        self._statuses = statuses_of("instance status", self._reconcile_instance_status)
        self._tasks = statuses_of("task", self._reconcile_task)
        self._templates: WorkQueue[Name] = queue("template", self._reconcile_template, _VALIDATION_WORKERS, 1)
        self._rules: WorkQueue[RuleKey] = queue("rule", self._reconcile_rule, _VALIDATION_WORKERS, 1)
        self.detector_index = DetectorIndex(options.detectors)
        detectors = DetectorWork(
            self.cache,
            client,
            self.detector_index,
            lambda name: self._rules.add((DETECTOR, name)),
            self.recorder,
        )
        self.detectors = queue("detector", self._where_active(detectors.reconcile), 1)
        queues = (instances, self._statuses, self._tasks, self._templates, self._rules, self.detectors)
        measures.registry.register(Overview(self.cache, lambda: [(each.name, *each.depth) for each in queues]))
        self.publisher = Publisher(options.zenoh)
        self._configurations: WorkQueue[Name] = WorkQueue(
            "configuration",
            ConfigurationWork(self.cache, client, applier, self.publisher).reconcile,
            _CONFIGURATION_WORKERS,
            measure=measures.reconciled,
        )
        self.queues = (*queues, self._configurations)
        self.pool = Pool(measures, options.cpu_time)
        self._answers = AnswerCache(self.pool)
        self.router = Router(
            self.cache,
            applier,
            instances.add,
            self._tasks.add,
            lambda name: self._templates.add_at(name, time.time() + _VALIDATION_PAUSE),
            self._validate,
            self._configurations.add,
        )
        self.cache.claims.claim_of = partial(evaluate_claim, self._answers, self.router.claimed)
        self.cache.claims.resolved = self.router.claims_resolved
        self.cache.claims.budget_changed = self.router.claimed
        self.cache.overlap.every = options.resync
        self.cache.overlap.resumed = lambda _: self.router.enqueue_everything()
        statuses = StatusWriter(client, self.recorder, self.router.observe)
        self._status_work = InstanceStatusWork(
            cache=self.cache,
            statuses=statuses,
            applier=applier,
            task_changed=self._tasks.add,
            nodes=NodePoll(client),
            failed_pods=FailedPodsPoll(client),
            enqueue_at=self._statuses.add_at,
        )
        charts = ChartCache(options.helm, options.chart_cache, options.chart_folder)
        self.charts = ChartRenderer(options.helm, charts, instances.add_at)
        self._renderings = Renderings(
            self.cache, self._answers, self.charts.outcome, instances.add, self._templates.add
        )
        self._instance_work = InstanceWork(
            cache=self.cache,
            client=client,
            applier=applier,
            recorder=self.recorder,
            scaler=WorkloadScaler(client, applier, self.router.observe),
            enqueue_at=instances.add_at,
            enqueue=instances.add,
            done=self._statuses.add,
            absent=self._absent,
            not_created=self._status_work.report_not_created,
            observe=self.router.observe,
            configured=self._configurations.add,
            objects=self._renderings.objects,
        )
        self._task_work = TaskWork(
            cache=self.cache,
            client=client,
            statuses=statuses,
            ttl=options.ttl_after_finished,
            enqueue_at=self._tasks.add_at,
            observe=self.router.observe,
            measures=measures,
            traces=self._traces,
        )
        self._template_work = TemplateWork(self.cache, statuses, self.pool, self._templates.add_at)
        self._rule_work = RuleWork(self.cache, statuses, self.pool, self.detector_index)

    async def close(self) -> None:
        """Stop the background work."""
        await self._answers.close()
        await self.pool.close()
        await self.charts.close()

    def _absent(self, name: Name, decision: Decision | None) -> None:
        self._renderings.forget(name)
        self._status_work.report(name, decision, None)

    def begin_term(self, children: Iterable[Resource]) -> None:
        """Start to act: forget the results of this manager, because others may have acted meanwhile.

        `children`: the kinds of the objects of templates.
        """
        self.cache.forget_work()
        self.publisher.forget()
        self.applier.begin(
            entry.raw for each in children for _, entry in self.cache.store.all((each.api_version, each.kind))
        )

    def publish_all(self) -> None:
        """Enqueue the publication of the configurations of all instances."""
        for name, _ in self.cache.store.all(INSTANCE):
            self._configurations.add(name)

    async def _is_active_in(self, namespace: str) -> bool:
        """Whether this manager, and no older one, is active in the namespace. Raises NotGranted if it may not write."""
        await self.client.check_granted(namespace)  # before any read: otherwise each object there would cost a request
        return not self.cache.overlap.yields(namespace)

    def _where_active(self, reconcile: Callable[[Name], Awaitable[None]]) -> Callable[[Name], Awaitable[None]]:
        """The same work, limited to namespaces in which this manager is active."""

        async def work(name: Name) -> None:
            if await self._is_active_in(name[0]):
                await reconcile(name)

        return work

    async def _reconcile_instance(self, name: Name) -> None:
        if self._traces is None:
            await self._instance_work.reconcile(name)
        else:
            await self._traces.reconciling(name, self._instance_work.reconcile)

    async def _reconcile_instance_status(self, name: Name) -> None:
        await self._status_work.reconcile(name)

    async def _reconcile_task(self, name: Name) -> None:
        await self._task_work.reconcile(name)

    async def _reconcile_template(self, name: Name) -> None:
        await self.client.check_granted(name[0])
        await self._template_work.reconcile(name)

    async def _reconcile_rule(self, key: RuleKey) -> None:
        if await self._is_active_in(key[1][0]):
            await self._rule_work.reconcile(key)

    def _validate(self, key: RuleKey) -> None:
        """Enqueue the check of a rule or Detector; a Detector's objects are usually reconciled first."""
        self._rules.add_at(key, time.time() + _VALIDATION_PAUSE)
        if key[0] == DETECTOR:
            self.detectors.add(key[1])
