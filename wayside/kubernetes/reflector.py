"""A reflector: keeps a list of objects current by a list, a watch from its resourceVersion, and regular new lists.

A watch may lose its connection, the server may lose the history that the watch needs (410), and no watch proves that it
missed nothing. So each watch lasts for only one resync period, and a new list always follows it. Intermediate states do
not matter: the list is the current state.
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
    """The list of all existing objects. Any other known object has been deleted."""

    objects: list[Object]
    version: int
    """The resource version of the list. Objects with a greater resource version are newer than the list."""


@dataclass(frozen=True)
class Changed:
    """An object was created or changed."""

    object: Object


@dataclass(frozen=True)
class Deleted:
    """An object was deleted. `object` is its last state."""

    object: Object


Change = Replaced | Changed | Deleted


def version_of(obj: Object) -> int:
    """An object's resource version. The API guarantees that it is an integer that only grows."""
    return int(obj["metadata"]["resourceVersion"])


@dataclass
class Reflector:
    """Follows the objects of one kind in one namespace, as long as the caller iterates."""

    client: Client
    resource: Resource
    namespace: str
    labels: str = field(default="", kw_only=True)
    """The label selector of the objects to follow."""
    fields: str = field(default="", kw_only=True)
    """The field selector of the objects to follow."""
    resync: float = field(default=30.0, kw_only=True)
    """The resync period, in seconds, after which the objects are listed again."""
    lists: int = field(default=0, init=False)
    """The number of successful lists."""
    outages: int = field(default=0, init=False)
    """The number of times that the server stopped responding, or began to refuse requests."""
    _backoff: Backoff = field(default_factory=lambda: Backoff(0.1, 5.0), init=False)

    async def follow(self) -> AsyncGenerator[Change, None]:
        """Yields the list, then its changes. Never ends and never raises; errors are logged, counted and retried."""
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
                await asyncio.sleep(_PAUSE)  # a server that ends each watch at once must not receive a flood of lists
            except RequestError as error:
                gone = isinstance(error, ApiError) and error.code == 410  # expired, but the server responds
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
