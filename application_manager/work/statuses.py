"""Writes the statuses of all kinds, if they differ, and posts Events about changed conditions."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from application_manager.core.statuses.status import difference
from application_manager.work.recorder import Recorder
from wayside.api.base import Condition, Kind
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.resources import Object, Resource


class KindStatus(Protocol):
    """The status of one of our kinds."""

    @property
    def conditions(self) -> Sequence[Condition]:
        """Its conditions."""

    def to_json(self) -> dict[str, Any]:
        """The status as JSON for the API server."""


@dataclass(frozen=True, slots=True)
class StatusWriter:
    """Writes statuses; `observe` puts the API server's response into the cache."""

    client: Client
    recorder: Recorder
    observe: Callable[[Object], None]

    async def write(
        self,
        resource: Resource,
        regarding: Kind,
        old: KindStatus | None,
        new: KindStatus,
        now: float,
        conditions: Collection[str] | None = None,
    ) -> bool:
        """Write the changed fields of a status, if any; returns whether the object exists.

        `old` is None if it has no status; `now` is in seconds since 1970; `conditions`: the types of conditions whose
        changes have an Event, None for all. Raises RequestError for a temporary error.
        """
        patch = difference(old.to_json() if old is not None else {}, new.to_json())
        if not patch:
            return True
        if not await self.merge(resource, regarding, patch):
            return False
        worth = [each for each in new.conditions if conditions is None or each.type in conditions]
        self.recorder.transitions(regarding, old.conditions if old is not None else (), worth, now)
        return True

    async def merge(self, resource: Resource, regarding: Kind, patch: Object) -> bool:
        """Merge into the status, null removes a field; returns whether the object exists. Raises RequestError."""
        namespace, name, uid = regarding.namespace, regarding.name, regarding.metadata.uid
        try:
            self.observe(await self.client.patch_status(resource, namespace, name, uid, patch))
        except ApiError as error:
            if error.terminating or error.code == 404 or error.replaced:
                return False
            raise
        return True
