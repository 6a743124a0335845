"""The running manager: everything wired together, started in order and stopped at once.

The order matters: all objects are listed before anything is decided, so that nothing is stopped for want of knowing
what demands it. Then the watches, the queues and the periodic looks run side by side; if one of them ends, all do.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import time
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import kopf
import zenoh

from application_manager.apply import Applier
from application_manager.chartcache import ChartCache, default_folder
from application_manager.chartdesk import ChartDesk
from application_manager.client import ApiError, Client, Resource
from application_manager.configurations import ConfigurationWork
from application_manager.connection import ConfigurationError, load_configuration
from application_manager.core.policy import KindKey, Policy, kind_text
from application_manager.helm import Helm
from application_manager.instances import InstanceWork
from application_manager.instancestatus import InstanceStatusWork
from application_manager.leasewatch import LeaseWatch
from application_manager.listing import Listing
from application_manager.measures import Measures
from application_manager.operator import watch
from application_manager.overview import Overview
from application_manager.pages import pages, stalled
from application_manager.publishing import Publisher
from application_manager.recorder import Recorder
from application_manager.router import Router
from application_manager.rulework import RuleKey, RuleWork
from application_manager.starting import until_answered
from application_manager.store import Name
from application_manager.suspending import Suspending
from application_manager.tasks import TaskWork
from application_manager.templates import TemplateWork
from application_manager.workqueue import Key, WorkQueue
from application_manager.world import INSTANCE, OWN_KINDS, POD, TASK, TEMPLATE, World

JUDGING_PAUSE = 0.3  # s from news of a template, rule or detector to its status: what comes together is one
_INSTANCE_WORKERS = 16
_CONFIGURATION_WORKERS = 4
_STATUS_WORKERS = 2  # few: what runs goes before what is said of it

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line says.

    Attributes:
        policy: what templates may create.
        namespaces: those to look at; empty: all.
        resync: seconds between two full resyncs.
        ttl_after_finished: seconds that finished tasks are kept.
        metrics_port: where metrics and health are served; None: nowhere.
        zenoh: where configurations are published; None: nowhere.
        helm: renders charts.
        chart_cache: the folder in which fetched charts are kept.
        chart_folder: the folder with the charts of the image.
    """

    policy: Policy = field(default_factory=Policy)
    namespaces: tuple[str, ...] = ()
    resync: float = 60.0
    ttl_after_finished: float = 3600.0
    metrics_port: int | None = None
    zenoh: zenoh.Config | None = None
    helm: Helm = field(default_factory=Helm)
    chart_cache: Path = field(default_factory=default_folder)
    chart_folder: Path = Path("/charts")


async def serve(options: Options) -> None:
    """Run the manager until SIGTERM or SIGINT.

    Raises:
        ConfigurationError: there is no cluster, it lacks our CRDs, or refuses what the manager needs, such as listing;
            or the port for metrics is taken.
    """
    measures = Measures()
    client = Client(await load_configuration(), measures)
    try:
        resources = await _discovered(client, options.policy)
        helm = replace(options.helm, kube_version=await until_answered(client.server_version))
        await Manager(client, replace(options, helm=helm), resources, measures).run()
    except ApiError as error:
        raise ConfigurationError(
            f"the API server refuses what the manager needs: {error}; check the account and its rights"
        ) from error
    finally:
        await client.close()


class Manager:
    """All parts of one manager."""

    def __init__(
        self, client: Client, options: Options, resources: dict[KindKey, Resource], measures: Measures
    ) -> None:
        self._client = client
        self._measures = measures
        self._options = options
        self._world = World(options.policy)
        self._recorder = Recorder(client, measures)
        applier = Applier(client, self._world.store, resources)
        self._instances: WorkQueue[Name] = WorkQueue(
            "instance", self._reconcile_instance, _INSTANCE_WORKERS, measures=measures
        )
        self._statuses: WorkQueue[Name] = WorkQueue(
            "instance status", self._say_instance, _STATUS_WORKERS, self._instances, measures
        )
        self._tasks: WorkQueue[Name] = WorkQueue(
            "task", self._reconcile_task, _STATUS_WORKERS, self._instances, measures
        )
        self._templates: WorkQueue[Name] = WorkQueue("template", self._reconcile_template, 1, self._instances, measures)
        self._rules: WorkQueue[RuleKey] = WorkQueue("rule", self._reconcile_rule, 1, self._instances, measures)
        queues = (self._instances, self._statuses, self._tasks, self._templates, self._rules)
        measures.registry.register(Overview(self._world, lambda: [(each.name, *each.depth) for each in queues]))
        self._publisher = Publisher(options.zenoh)
        self._configurations: WorkQueue[Name] = WorkQueue(
            "configuration",
            ConfigurationWork(self._world, client, applier, self._publisher).reconcile,
            _CONFIGURATION_WORKERS,
            measures=measures,
        )
        self._router = Router(
            self._world,
            applier,
            self._instances.add,
            self._tasks.add,
            _soon(self._templates),
            _soon(self._rules),
            self._configurations.add,
        )
        self._status_work = InstanceStatusWork(
            world=self._world,
            client=client,
            applier=applier,
            recorder=self._recorder,
            instances=resources[INSTANCE],
            task_changed=self._tasks.add,
            observe=self._router.observe,
        )
        cache = ChartCache(options.helm, options.chart_cache, options.chart_folder)
        self._charts = ChartDesk(options.helm, cache, self._instances.add_at)
        self._instance_work = InstanceWork(
            world=self._world,
            client=client,
            applier=applier,
            recorder=self._recorder,
            suspending=Suspending(client, applier, resources[INSTANCE], self._router.observe),
            instances=resources[INSTANCE],
            tasks=resources[TASK],
            again=self._instances.add_at,
            done=self._statuses.add,
            absent=lambda name, decision: self._status_work.tell(name, decision, None),
            observe=self._router.observe,
            configured=self._configurations.add,
            charts=self._charts.outcome,
        )
        self._task_work = TaskWork(
            world=self._world,
            client=client,
            recorder=self._recorder,
            tasks=resources[TASK],
            templates=resources[TEMPLATE],
            ttl=options.ttl_after_finished,
            again=self._tasks.add_at,
            observe=self._router.observe,
            measures=measures,
        )
        self._template_work = TemplateWork(
            world=self._world,
            client=client,
            recorder=self._recorder,
            templates=resources[TEMPLATE],
            observe=self._router.observe,
        )
        own = [resources[kind] for kind in OWN_KINDS]
        # Pods always: those of workloads tell why they do not run.
        children = [resources[kind] for kind in sorted({*options.policy.kinds, POD}) if kind in resources]
        self._listing = Listing(
            world=self._world,
            client=client,
            router=self._router,
            own=own,
            children=children,
            namespaces=options.namespaces,
            every=options.resync,
            measures=measures,
        )
        self._leases = LeaseWatch(self._world, client, own[0], options.namespaces, self._router.look_at)
        self._rule_work = RuleWork(
            world=self._world,
            client=client,
            recorder=self._recorder,
            resources=resources,
            observe=self._router.observe,
        )

    async def run(self) -> None:
        """Run until SIGTERM or SIGINT."""
        stop = asyncio.Event()
        watching = asyncio.Event()
        _on_signals(stop)
        healthy = stalled(self._measures, self._options.resync)
        async with pages(self._options.metrics_port, self._measures, healthy, lambda: self._lacks(watching)):
            if await _until(stop, self._listing.first()):
                await self._work(watching, stop)

    def _lacks(self, watching: asyncio.Event) -> str | None:
        if not watching.is_set():
            return "not everything is listed and watched yet"
        return None if self._world.healthy.reached else "the API server does not answer"

    async def _work(self, watching: asyncio.Event, stop: asyncio.Event) -> None:
        tasks = [
            asyncio.create_task(self._watch(watching), name="watches"),
            asyncio.create_task(self._instances.run(), name="instances"),
            asyncio.create_task(self._statuses.run(), name="instance statuses"),
            asyncio.create_task(self._tasks.run(), name="tasks"),
            asyncio.create_task(self._templates.run(), name="templates"),
            asyncio.create_task(self._rules.run(), name="rules"),
            asyncio.create_task(self._configurations.run(), name="configurations"),
            asyncio.create_task(self._publisher.run(), name="zenoh"),
            asyncio.create_task(self._recorder.run(), name="events"),
            asyncio.create_task(self._leases.run(), name="leases"),
            asyncio.create_task(self._listing.resync(watching), name="resync"),
            asyncio.create_task(self._announce(watching, stop), name="signals"),
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await self._charts.close()
        for task in done:
            task.result()
        log.info("stopped")

    async def _reconcile_instance(self, name: Name) -> None:
        await self._instance_work.reconcile(name)

    async def _say_instance(self, name: Name) -> None:
        await self._status_work.reconcile(name)

    async def _reconcile_task(self, name: Name) -> None:
        await self._task_work.reconcile(name)

    async def _reconcile_template(self, name: Name) -> None:
        await self._template_work.reconcile(name)

    async def _reconcile_rule(self, key: RuleKey) -> None:
        await self._rule_work.reconcile(key)

    async def _announce(self, watching: asyncio.Event, stop: asyncio.Event) -> None:
        await watching.wait()
        _on_signals(stop)  # kopf has put its own handlers in their place, which wait for tasks of ours
        where = f"namespaces {', '.join(self._options.namespaces)}" if self._options.namespaces else "all namespaces"
        log.info("watching %s", where)
        await stop.wait()

    async def _watch(self, watching: asyncio.Event) -> None:
        await watch(
            self._listing.own,
            self._listing.children,
            observe=self._router.observe,
            vanished=self._router.vanished,
            connect=self._connection,
            namespaces=self._options.namespaces,
            ready=watching,
        )

    async def _connection(self) -> kopf.ConnectionInfo:
        configuration = self._client.configuration
        token = await configuration.get_api_key_with_prefix("BearerToken", alias="authorization")
        scheme, _, credentials = (token or "").partition(" ")
        return kopf.ConnectionInfo(
            server=configuration.host,
            ca_path=configuration.ssl_ca_cert,
            ca_data=None if configuration.ssl_ca_cert else configuration.ca_cert_data,
            insecure=not configuration.verify_ssl,
            scheme=scheme if credentials else None,
            token=credentials or scheme or None,
            certificate_path=configuration.cert_file,
            private_key_path=configuration.key_file,
        )


async def _discovered(client: Client, policy: Policy) -> dict[KindKey, Resource]:
    """Where our own kinds and those of the policy live; a kind that the cluster lacks is left out, and said."""
    found: dict[KindKey, Resource] = {}
    for version in sorted({each[0] for each in (*OWN_KINDS, POD, *policy.kinds)}):
        found |= await until_answered(partial(client.discover, version))
    lacking = [kind_text(kind) for kind in OWN_KINDS if kind not in found]
    if lacking:
        raise ConfigurationError(f"the cluster has no kind {', '.join(lacking)}: run kubectl apply -f crds/")
    for kind in sorted(policy.kinds):
        if kind not in found:
            log.warning("the cluster has no kind %s: templates that use it fail", kind_text(kind))
        elif not found[kind].namespaced:
            raise ConfigurationError(f"{kind_text(kind)} is not namespaced and can never be allowed")
    return found


def _soon(queue: WorkQueue[Key]) -> Callable[[Key], None]:
    return lambda key: queue.add_at(key, time.time() + JUDGING_PAUSE)


def _on_signals(stop: asyncio.Event) -> None:
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)


async def _until(stop: asyncio.Event, work: Coroutine[None, None, None]) -> bool:
    """Do the work unless told to stop; whether it was done."""
    working = asyncio.create_task(work)
    stopping = asyncio.create_task(stop.wait())
    await asyncio.wait((working, stopping), return_when=asyncio.FIRST_COMPLETED)
    stopping.cancel()
    if not working.done():
        working.cancel()
        await asyncio.gather(working, return_exceptions=True)
        return False
    working.result()
    return True
