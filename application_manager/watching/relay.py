"""News go from kopf's watches straight to where they are taken, and not through kopf's queues.

kopf keeps a task and a queue for each object that has news, and the object itself with them. For handlers that do no
more than put an object into a cache, that is most of the time and the memory that the news take. So kopf keeps the
watches up (connections, retries, versions that are too old), and sees of each event its version. Its lists are ours: it
learns the version to watch from, and we list what is there after that. docs/decisions/0027 has the details.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Any

from kopf._cogs.clients import fetching, watching

from application_manager.cluster.client import ApiError, Object, Unreachable

News = Callable[[Object], None]
Relist = Callable[[Any, str | None], Awaitable[None]]
"""Lists a resource of kopf's again; in a namespace, or in all for None. May raise ApiError or Unreachable."""

log = logging.getLogger(__name__)


@contextmanager
def relaying(observe: News, vanished: News, relist: Relist) -> Iterator[None]:
    """Hand on the news of kopf's watches while the block runs.

    Args:
        observe: takes an object that is new or was changed.
        vanished: takes an object that is gone.
        relist: hands on all that there is.
    """
    watch: Any = watching.watch_objs
    fetch = fetching.fetch_objs
    takers = {"ADDED": observe, "MODIFIED": observe, "DELETED": vanished}

    async def watch_objs(**about: Any) -> AsyncIterator[Any]:
        async for event in watch(**about):
            take = takers.get(event["type"])
            if take is None:
                yield event
                continue
            raw: Object = event["object"]
            try:
                take(raw)
            except Exception:  # a defect in taking one object must not stop the watch
                log.exception("%s %s could not be taken", raw.get("kind"), raw["metadata"].get("name"))
            version = raw["metadata"]["resourceVersion"]
            del event, raw
            yield {"type": "BOOKMARK", "object": {"metadata": {"resourceVersion": version}}}
            await asyncio.sleep(0)  # many may have arrived: the work goes on in between

    async def fetch_objs(*, resource: Any, namespace: Any, **about: Any) -> AsyncIterator[Any]:
        version = None
        async for _, as_of in fetch(resource=resource, namespace=namespace, **about):
            version = as_of
            break
        try:
            await relist(resource, namespace)
        except (ApiError, Unreachable) as error:
            log.warning("%s cannot be listed: %s", resource.plural, error)
            raise TimeoutError from error  # which kopf takes as a reason to begin anew
        yield [], version

    watching.watch_objs, fetching.fetch_objs = watch_objs, fetch_objs
    try:
        yield
    finally:
        watching.watch_objs, fetching.fetch_objs = watch, fetch
