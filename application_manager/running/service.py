"""The running manager: starts watches, queues and servers in order, and stops them together.

The order matters: all objects are listed before any decision, so that nothing is stopped because a demand is not known
yet. Then the watches and the periodic lists run concurrently and, while this manager is active, the queues as well
(`acting`); if one of them ends, all end. A standby has the same caches as the active manager, and writes nothing.
"""

from __future__ import annotations

import asyncio
import logging
import signal
from dataclasses import replace
from functools import partial

import kopf

from application_manager.admission.admission import Admission
from application_manager.admission.issuer import issuing
from application_manager.admission.webhook import ReviewHandler, webhook
from application_manager.cache.cluster_cache import POD, TEMPLATES
from application_manager.cluster.client import manager_client
from application_manager.cluster.leadership import RENEWAL_TIMEOUT, Leadership
from application_manager.cluster.permissions import NamespacePermissions
from application_manager.core.findings.webhooks import INJECTION_PATH, PATH
from application_manager.measures import Measures
from application_manager.observability.pages import pages, stalled
from application_manager.running.assembly import Assembly
from application_manager.running.options import Options
from application_manager.running.prerequisites import (
    check_rights,
    check_selectable_fields,
    check_version,
    discover_resources,
)
from application_manager.running.watchdog import SILENT, watchdog
from application_manager.watching.detectorwatch import DetectorWatch
from application_manager.watching.leasewatch import LeaseWatch
from application_manager.watching.operator import watch
from application_manager.watching.resync import Resync
from application_manager.watching.watch_health import WatchHealth
from application_manager.work.active import acting, cancel_and_wait, run_until_stopped
from wayside.kubernetes.connection import ConfigurationError, load_configuration
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.pacing import CongestionWindow, Pacing
from wayside.kubernetes.retrying import until_answered
from wayside.process.tracing import tracing

log = logging.getLogger(__name__)


async def serve(options: Options) -> None:
    """Run the manager until SIGTERM or SIGINT.

    Raises:
        ConfigurationError: there is no cluster, its CRDs are missing, it refuses a request that the manager needs, or
            the port for metrics is in use.
    """
    measures, traced = Measures(), tracing("wayside-application-manager")
    client = manager_client(await load_configuration(), measures, pacing=Pacing(share=CongestionWindow()))
    # A separate client: other requests do not delay renewals of the Lease.
    renewals = manager_client(await load_configuration(), measures, timeout=RENEWAL_TIMEOUT)
    leadership = Leadership(renewals, options.lease, measures)
    client.may_act = leadership.remaining
    try:
        version = await check_version(client)
        resources = await discover_resources(client, options.policy)
        runs = options.detectors is not None
        await check_rights(client, options.policy, resources, options.namespaces, options.lease, detectors=runs)
        await check_selectable_fields(client, options.namespaces)
        helm = replace(options.helm, kube_version=version)
        async with issuing(renewals, options.admission):
            work = Assembly(client, replace(options, helm=helm), resources, measures, traced)
            await Manager(work, leadership).run()
    except ApiError as error:
        raise ConfigurationError(
            f"the API server refuses a request that the manager needs: {error}; check the permissions of the manager's "
            "service account: `application-manager rbac` prints them"
        ) from error
    finally:
        await client.close()
        await renewals.close()
        if traced is not None:
            traced.close()


class Manager:
    """All parts of one manager."""

    def __init__(self, work: Assembly, leadership: Leadership) -> None:
        self._work = work
        self._leadership = leadership
        client, options, resources, measures = work.client, work.options, work.resources, work.measures
        # Pods are always included: they show why workloads do not run.
        children = [resources[kind] for kind in sorted({*options.policy.kinds, POD}) if kind in resources]
        self._resync = Resync(
            cache=work.cache,
            client=client,
            router=work.router,
            children=children,
            namespaces=options.namespaces,
            every=options.resync,
            measures=measures,
        )
        work.cache.overlap.own = lambda: leadership.lease
        self._watch_health = WatchHealth(options.watch_timeout, lambda: work.cache.healthy.elapsed)
        measures.registry.register(self._watch_health)
        self._detector_watch = DetectorWatch(
            work.cache, client, work.detector_index, options.namespaces, work.detectors.add
        )
        self._permissions = NamespacePermissions(client, work.router.enqueue_everything)
        if not options.namespaces:
            client.may_write = self._permissions.may_write
        self._leases = LeaseWatch(work.cache, client, TEMPLATES, options.namespaces, work.router.enqueue_instance)
        self._admission = Admission(
            cache=work.cache,
            client=client,
            observe=work.router.observe,
            measures=measures,
            pool=work.pool,
            namespaces=options.namespaces,
            defaults=options.detectors,
        )

    async def run(self) -> None:
        """Run until SIGTERM or SIGINT."""
        stop = asyncio.Event()
        watching = asyncio.Event()
        review_handlers = {
            path: ReviewHandler(review, watching.is_set, self._work.measures)
            for path, review in ((PATH, self._admission.review), (INJECTION_PATH, self._admission.inject))
        }
        _on_signals(stop)
        limit = self._work.options.stalled_after
        stall = stalled(self._work.measures, self._work.options.resync, self._work.queues, limit)

        def healthy() -> str | None:
            return stall() or self._watch_health.dead()

        ready = partial(self._not_ready, watching)
        async with (
            watchdog(healthy, min(SILENT, limit)),
            pages(
                self._work.options.metrics_port,
                self._work.measures,
                healthy,
                ready,
                lambda: self._leadership.role,
                self._work.options.metrics_certificates,
            ),
            webhook(self._work.options.admission, review_handlers),
        ):
            try:
                if await run_until_stopped(stop, self._first()):
                    await self._watch_and_act(watching, stop)
                else:
                    await self._leadership.release()
            finally:
                await self._work.close()

    async def _first(self) -> None:
        """Determine whether we are active, then list everything, so that an active manager decides on newer lists."""
        await until_answered(self._leadership.refresh)
        await self._resync.list_all()

    def _not_ready(self, watching: asyncio.Event) -> str | None:
        if not watching.is_set() or not self._watch_health.begun("applicationtasks"):
            return "the caches are not synced yet"
        return None if self._work.cache.healthy.reached else "the API server does not respond"

    async def _watch_and_act(self, watching: asyncio.Event, stop: asyncio.Event) -> None:
        tasks = [
            asyncio.create_task(self._watch(watching), name="watches"),
            asyncio.create_task(self._leases.run(), name="leases"),
            asyncio.create_task(self._resync.resync(watching), name="resync"),
            asyncio.create_task(self._detector_watch.run(), name="detectors"),
            asyncio.create_task(self._leadership.run(), name="leadership"),
            asyncio.create_task(self._permissions.run(), name="permissions"),
            asyncio.create_task(self._act(stop), name="acting"),
            asyncio.create_task(self._announce(watching, stop), name="signals"),
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            await cancel_and_wait(*tasks)
        for task in done:
            task.result()
        log.info("stopped")

    async def _act(self, stop: asyncio.Event) -> None:
        """Act while we are active, until `stop` is set."""
        await acting(
            self._leadership,
            self._work.client,
            self._work.queues,
            (self._work.publisher, self._work.recorder),
            self._begin,
            stop,
        )

    async def _begin(self, again: bool) -> None:
        """Prepare to act. If others may have acted since the last list, everything is read from the cluster again."""
        if again:  # otherwise everything was listed after we acquired the Lease
            self._work.begin_term(self._resync.children)
            await self._resync.list_all()
            self._work.publish_all()
        self._work.cache.claims.begin()

    async def _announce(self, watching: asyncio.Event, stop: asyncio.Event) -> None:
        await watching.wait()
        _on_signals(stop)  # kopf has replaced them with its own handlers, which wait for tasks of ours
        where = (
            f"namespaces {', '.join(self._work.options.namespaces)}"
            if self._work.options.namespaces
            else "all namespaces"
        )
        log.info("watching %s", where)
        await asyncio.Event().wait()  # `_act` ends all others, after the last write

    async def _watch(self, watching: asyncio.Event) -> None:
        await watch(
            self._resync.children,
            observe=self._work.router.observe,
            deleted=self._work.router.deleted,
            relist=self._resync.relist,
            failed=self._work.measures.unhandled,
            connect=self._connection,
            namespaces=self._work.options.namespaces,
            ready=watching,
            health=self._watch_health,
        )

    async def _connection(self) -> kopf.ConnectionInfo:
        configuration = self._work.client.configuration
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


def _on_signals(stop: asyncio.Event) -> None:
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
