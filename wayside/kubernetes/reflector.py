"""A list of objects that is kept current: list, watch from there, and list again when in doubt.

A watch may lose its connection, or the server may lose the history that it needs (410), and no watch proves that
nothing was missed. So each watch lasts one resync period only, and a new list follows however it ends. Intermediate
states do not matter: the list is the current state.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator
from contextlib import aclosing
from dataclasses import dataclass, field

from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, RequestError
from wayside.kubernetes.resources import Object, Resource
from wayside.process.backoff import Backoff

_log = logging.getLogger(__name__)

_PAUSE = 0.1
"""Seconds between the end of a watch and the next list."""


@dataclass(frozen=True)
class Replaced:
    """All existing objects; any other object known before is deleted."""

    objects: list[Object]
    version: int
    """The resource version of the list: changes of an object with a greater one are newer than the list."""


@dataclass(frozen=True)
class Changed:
    """An object was created or changed."""

    object: Object


@dataclass(frozen=True)
class Deleted:
    """An object was deleted; has its last state."""

    object: Object


Change = Replaced | Changed | Deleted


def version_of(obj: Object) -> int:
    """An object's resource version; the API guarantees that they are integers that only grow."""
    return int(obj["metadata"]["resourceVersion"])


@dataclass
class Reflector:
    """Follows the objects of one kind in one namespace, as long as the caller iterates."""

    client: Client
    resource: Resource
    namespace: str
    labels: str = field(default="", kw_only=True)
    """Only what this label selector matches."""
    fields: str = field(default="", kw_only=True)
    """Only what this field selector matches."""
    resync: float = field(default=30.0, kw_only=True)
    """Seconds after which all is listed again, even if nothing seems to be missing."""
    lists: int = field(default=0, init=False)
    """Number of lists until now."""
    outages: int = field(default=0, init=False)
    """How often the server stopped responding or refused."""
    _backoff: Backoff = field(default_factory=lambda: Backoff(0.1, 5.0), init=False)

    async def follow(self) -> AsyncGenerator[Change, None]:
        """The list, then its changes. Never ends and raises nothing; errors are logged, counted and retried."""
        while True:
            try:
                objects, version = await self.client.list(
                    self.resource, self.namespace, labels=self.labels, fields=self.fields
                )
                self._recovered()
                yield Replaced(objects, int(version))
                async with aclosing(self._watch(version)) as changes:
                    async for change in changes:
                        yield change
                await asyncio.sleep(_PAUSE)  # do not flood a server that ends each watch at once with lists
            except RequestError as error:
                gone = isinstance(error, ApiError) and error.code == 410  # its history, but the server is there
                await asyncio.sleep(_PAUSE if gone else self._failed(error))

    async def _watch(self, since: str) -> AsyncGenerator[Change, None]:
        events = self.client.watch(
            self.resource,
            self.namespace,
            labels=self.labels,
            fields=self.fields,
            since=since,
            seconds=self.resync,
        )
        async with aclosing(events):
            async for event in events:
                kind = Deleted if event["type"] == "DELETED" else Changed
                yield kind(event["object"])

    def _recovered(self) -> None:
        self.lists += 1
        if self._backoff.failures:
            _log.info("the API server responds: reading the %s of namespace %s", self.resource.plural, self.namespace)
        self._backoff.succeed()

    def _failed(self, error: RequestError) -> float:
        if not self._backoff.failures:
            self.outages += 1
            _log.warning(
                "cannot read the %s of namespace %s; retrying with backoff: %s",
                self.resource.plural,
                self.namespace,
                error,
            )
        return self._backoff.fail(error.retry_after or 0.0)
