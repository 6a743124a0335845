"""A list of objects that is kept current: list, watch from there, and list again when in doubt.

A watch may lose its connection, or the server may lose the history that it needs (410), and no watch proves that
nothing was missed. So each watch lasts one resync period only, and a new list follows however it ends. Intermediate
states do not matter: the list is the current state.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, Mapping
from contextlib import aclosing
from dataclasses import dataclass

from detector.cluster.api import Api, JsonObject, Resource
from detector.cluster.errors import ApiError, GoneError, UnavailableError
from wayside.backoff import Backoff

_log = logging.getLogger(__name__)

_PAUSE = 0.1
"""Seconds between the end of a watch and the next list."""


@dataclass(frozen=True)
class Listed:
    """All existing objects; any other object known before is deleted."""

    objects: list[JsonObject]
    version: int
    """The resource version of the list: changes of an object with a greater one are newer than the list."""


@dataclass(frozen=True)
class Changed:
    """An object was created or changed."""

    object: JsonObject


@dataclass(frozen=True)
class Deleted:
    """An object was deleted; has its last state."""

    object: JsonObject


Change = Listed | Changed | Deleted


def version_of(obj: JsonObject) -> int:
    """An object's or a list's resource version; the API guarantees that they are integers that only grow."""
    return int(obj["metadata"]["resourceVersion"])


class Reflector:
    """Follows the objects of one kind in one namespace, as long as the caller iterates."""

    def __init__(
        self,
        api: Api,
        resource: Resource,
        namespace: str,
        selectors: Mapping[str, str] | None = None,
        resync: float = 30.0,
    ) -> None:
        """Prepare.

        Args:
            api: the connection.
            resource: which kind.
            namespace: where.
            selectors: `labelSelector`, `fieldSelector`, or none.
            resync: seconds after which all is listed again, even if nothing seems to be missing.
        """
        self._api = api
        self._resource = resource
        self._namespace = namespace
        self._selectors = selectors or {}
        self._resync = resync
        self._backoff = Backoff(0.1, 5.0)
        self.lists = 0
        """Number of lists so far."""
        self.outages = 0
        """How often the server stopped responding or refused."""

    async def follow(self) -> AsyncGenerator[Change, None]:
        """The list, then its changes. Never ends and raises nothing; errors are logged, counted and retried."""
        while True:
            try:
                listed = await self._api.list(self._resource, self._namespace, self._selectors)
                self._recovered()
                yield Listed(listed["items"], version_of(listed))
                async with aclosing(self._watch(listed["metadata"]["resourceVersion"])) as changes:
                    async for change in changes:
                        yield change
                await asyncio.sleep(_PAUSE)  # avoid flooding a server that ends each watch at once with lists
            except GoneError:
                await asyncio.sleep(_PAUSE)  # its history is gone, but the server is available
            except ApiError as error:
                await asyncio.sleep(self._failed(error))

    async def _watch(self, since: str) -> AsyncGenerator[Change, None]:
        events = self._api.watch(self._resource, self._namespace, self._selectors, since, self._resync)
        async with aclosing(events):
            async for event in events:
                kind = Deleted if event["type"] == "DELETED" else Changed
                yield kind(event["object"])

    def _recovered(self) -> None:
        self.lists += 1
        if self._backoff.failures:
            _log.info("reading the %s of namespace %s again", self._resource.plural, self._namespace)
        self._backoff.succeed()

    def _failed(self, error: ApiError) -> float:
        if not self._backoff.failures:
            self.outages += 1
            _log.warning(
                "cannot read the %s of namespace %s; retrying with backoff: %s",
                self._resource.plural,
                self._namespace,
                error,
            )
        return self._backoff.fail(error.retry_after if isinstance(error, UnavailableError) else 0.0)
