"""Registers the watches with kopf, and relays their events to the router directly, past kopf's queues.

It uses only `on.event` handlers, which neither add finalizers nor write to objects. kopf's own Events, peering and
progress storage are off. The API server selects holders' Leases and instances' objects by their labels.

kopf keeps a task, a queue and the object itself for each object with recent events. Handlers that only put objects into
a cache need none of these, and they would take most of the time and memory. So kopf maintains the watches (connections,
retries, expired versions) and sees only the version of each event. kopf's list provides the version to watch from; the
manager then lists the objects itself. See docs/decisions/0027.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any

import kopf
from kopf._cogs.clients import fetching, watching

from application_manager.cache.cluster_cache import OWN
from application_manager.core.objects.ownership import INSTANCE_LABEL
from application_manager.watching.watch_health import NEVER, WatchHealth, supervising
from wayside.kubernetes.errors import RequestError
from wayside.kubernetes.leases import HOLDER_LEASE_LABEL
from wayside.kubernetes.resources import LEASES, Object, Resource
from wayside.process.backoff import Backoff

Handler = Callable[[Object], None]
Relist = Callable[[Any, str | None, str], Awaitable[None]]
"""Lists one of kopf's resources: in a namespace, or in all for None, by a label selector.

May raise ApiError or Unreachable.
"""

log = logging.getLogger(__name__)

_FIRST_PAUSE, _LONGEST_PAUSE = 0.1, 1.0  # s between attempts to reach the API server


class _Pauses:
    """An endless series of pauses, which restarts at each iteration by kopf: a watch never gives up."""

    def __iter__(self) -> Iterator[float]:
        backoff = Backoff(_FIRST_PAUSE, _LONGEST_PAUSE)
        while True:
            yield backoff.fail()


async def watch(
    children: Collection[Resource],
    *,
    observe: Handler,
    deleted: Handler,
    relist: Relist,
    failed: Callable[[], None],
    connect: Callable[[], Awaitable[kopf.ConnectionInfo]],
    namespaces: Collection[str],
    ready: asyncio.Event,
    health: WatchHealth,
) -> None:
    """Watch our own kinds, holders' Leases, and objects with an instance's label, until cancelled.

    `namespaces` empty: all. `relist` lists a kind and routes its objects; `failed` counts an object that could not be
    handled. `health` receives each watch's signs of life. `ready` is set once kopf has started. `connect` returns
    credentials, at the start and when the API server no longer accepts them.
    """
    logging.getLogger("kopf").setLevel(logging.WARNING)
    registry = kopf.OperatorRegistry()
    settings = kopf.OperatorSettings()
    settings.posting.enabled = False
    settings.scanning.disabled = True  # the kinds and namespaces are given, so it needs no right to watch CRDs
    settings.networking.error_backoffs = _Pauses()
    settings.networking.request_timeout = 15
    settings.networking.connect_timeout = 5
    settings.watching.inactivity_timeout = NEVER  # see `supervising`
    settings.watching.chunk_size = 1  # its list only provides the version, see relaying
    settings.process.ultimate_exiting_timeout = None
    settings.queueing.exit_timeout = 0.1  # s; the next start lists everything that is lost by stopping immediately

    async def login(**_: Any) -> kopf.ConnectionInfo:
        return await connect()

    async def handled(**_: Any) -> None:
        """Make kopf watch a kind; the relay handles the events."""

    kopf.on.login(registry=registry)(login)
    for resource in OWN.values():
        kopf.on.event(resource.group, resource.version, resource.plural, registry=registry)(handled)
    for resource, label in ((LEASES, HOLDER_LEASE_LABEL), *((each, INSTANCE_LABEL) for each in children)):
        kopf.on.event(resource.group, resource.version, resource.plural, registry=registry)(handled)
        settings.watching.label_selectors[resource.group, resource.version, resource.plural] = label

    identity: Any = "application-manager"  # otherwise kopf looks up the user's name, which may not exist
    with supervising(health), relaying(observe, deleted, relist, failed):
        await kopf.operator(
            registry=registry,
            settings=settings,
            identity=identity,
            standalone=True,
            clusterwide=not namespaces,
            namespaces=namespaces,
            ready_flag=ready,
        )


@contextmanager
def relaying(observe: Handler, deleted: Handler, relist: Relist, failed: Callable[[], None]) -> Iterator[None]:
    """Relay the events of kopf's watches while the block runs.

    `observe` and `deleted` handle an object, `failed` counts one that they could not handle, and `relist` lists a
    kind.
    """
    watch: Any = watching.watch_objs
    fetch = fetching.fetch_objs
    handlers = {"ADDED": observe, "MODIFIED": observe, "DELETED": deleted}

    async def watch_objs(**about: Any) -> AsyncIterator[Any]:
        async for event in watch(**about):
            handle = handlers.get(event["type"])
            if handle is None:
                yield event
                continue
            raw: Object = event["object"]
            try:
                handle(raw)
            except Exception:  # a defect in handling one object must not stop the watch
                name = raw["metadata"].get("name")
                log.exception("cannot handle %s %s; retrying at the next resync", raw.get("kind"), name)
                failed()
            version = raw["metadata"]["resourceVersion"]
            del event, raw
            yield {"type": "BOOKMARK", "object": {"metadata": {"resourceVersion": version}}}
            await asyncio.sleep(0)  # many events may have arrived: let other tasks run in between

    async def fetch_objs(*, settings: Any, resource: Any, namespace: Any, **about: Any) -> AsyncIterator[Any]:
        version, labels = None, ",".join(sorted(set(settings.watching.label_selectors.collect(resource))))
        async for _, as_of in fetch(settings=settings, resource=resource, namespace=namespace, **about):
            version = as_of
            break
        try:
            await relist(resource, namespace, labels)
        except RequestError as error:
            log.warning("cannot list %s; retrying with backoff: %s", resource.plural, error)
            raise TimeoutError from error  # then kopf retries the list
        yield [], version

    watching.watch_objs, fetching.fetch_objs = watch_objs, fetch_objs
    try:
        yield
    finally:
        watching.watch_objs, fetching.fetch_objs = watch, fetch
