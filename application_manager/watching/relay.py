"""Relays events from kopf's watches to the router directly, past kopf's queues.

kopf keeps a task, a queue and the object itself for each object with recent events. Handlers that only put objects into
a cache need none of these, and they would take most of the time and memory. So kopf maintains the watches (connections,
retries, expired versions) and sees only the version of each event. kopf's list provides the version to watch from; the
manager then lists the objects itself. See docs/decisions/0027.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Any

from kopf._cogs.clients import fetching, watching

from wayside.kubernetes.errors import RequestError
from wayside.kubernetes.resources import Object

Handler = Callable[[Object], None]
Relist = Callable[[Any, str | None, str], Awaitable[None]]
"""Lists a resource of kopf's again: in a namespace, or in all for None, by a label selector. May raise ApiError or
Unreachable."""

log = logging.getLogger(__name__)


@contextmanager
def relaying(observe: Handler, vanished: Handler, relist: Relist, failed: Callable[[], None]) -> Iterator[None]:
    """Relay the events of kopf's watches while the block runs.

    Args:
        observe: handles an object that was added or modified.
        vanished: handles an object that was deleted.
        relist: lists a kind and routes all of its objects.
        failed: counts an object that could not be handled.
    """
    watch: Any = watching.watch_objs
    fetch = fetching.fetch_objs
    handlers = {"ADDED": observe, "MODIFIED": observe, "DELETED": vanished}

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
            await asyncio.sleep(0)  # many may have arrived: the work continues in between

    async def fetch_objs(*, settings: Any, resource: Any, namespace: Any, **about: Any) -> AsyncIterator[Any]:
        version, labels = None, ",".join(sorted(set(settings.watching.label_selectors.collect(resource))))
        async for _, as_of in fetch(settings=settings, resource=resource, namespace=namespace, **about):
            version = as_of
            break
        try:
            await relist(resource, namespace, labels)
        except RequestError as error:
            log.warning("cannot list %s; retrying with backoff: %s", resource.plural, error)
            raise TimeoutError from error  # on which kopf retries the list
        yield [], version

    watching.watch_objs, fetching.fetch_objs = watch_objs, fetch_objs
    try:
        yield
    finally:
        watching.watch_objs, fetching.fetch_objs = watch, fetch
