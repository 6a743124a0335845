"""Lists objects that are not watched, if the account may list them.

Nodes matter only while an application that requires certain nodes is not ready; they show a cause that the scheduler
does not report. A cluster has many Events: those about a workload matter only while its pods cannot be created, and its
own status does not give the reason.
"""

from __future__ import annotations

import asyncio
import logging
import time

from application_manager.core.health.placement import Nodes
from application_manager.core.health.refusals import FAILED_CREATE
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, Unreachable
from wayside.kubernetes.resources import EVENTS, Object, Resource

NODES = Resource("v1", "Node", "nodes", namespaced=False)
FRESH = 2.0  # s for which a result is reused
FORBIDDEN_FOR = 60.0  # s after which a list that was forbidden is tried again
_NEWEST = 50  # Events of one workload to read; the API server keeps them for an hour, which bounds their number

log = logging.getLogger(__name__)


class _Poll:
    """Lists objects of a kind, and logs once if they cannot be listed."""

    def __init__(self, client: Client, resource: Resource, without: str) -> None:
        """`without`: the log message about the consequence, with a placeholder for the error."""
        self._client = client
        self._resource = resource
        self._without = without
        self._forbidden_until = 0.0  # monotonic
        self._logged = False

    async def objects(self, namespace: str | None, fields: str = "", limit: int = 0) -> list[Object] | None:
        """The objects; None if they may not be listed, or the API server does not respond."""
        if time.monotonic() < self._forbidden_until:
            return None
        try:
            found, _ = await self._client.list(self._resource, namespace, fields=fields, limit=limit)
        except ApiError as error:
            if error.code == 403:
                self._forbidden_until = time.monotonic() + FORBIDDEN_FOR
            if not self._logged:
                log.info(self._without, error)
                self._logged = True
            return None
        except Unreachable:
            return None
        return found


class FailedPodsPoll:
    """The Events FailedCreate of workloads."""

    def __init__(self, client: Client) -> None:
        self._poll = _Poll(
            client,
            EVENTS,
            "cannot list Events (%s): statuses do not report why pods of a StatefulSet cannot be created",
        )

    async def events(self, namespace: str, uid: str) -> list[Object]:
        """The Events of the object with this uid; none if they may not be listed, or there is no response."""
        return await self._poll.objects(namespace, f"regarding.uid={uid},reason={FAILED_CREATE}", _NEWEST) or []


class NodePoll:
    """The labels of all nodes, at most a few seconds old."""

    def __init__(self, client: Client) -> None:
        self._poll = _Poll(client, NODES, "cannot list nodes (%s): only the scheduler reports why a pod fits no node")
        self._known: Nodes | None = None
        self._until = 0.0  # monotonic time until which the result is reused
        self._polling = asyncio.Lock()

    async def labels(self) -> Nodes | None:
        """The labels of nodes by name; None if they may not be listed, or the API server does not respond."""
        async with self._polling:
            if time.monotonic() >= self._until:
                found = await self._poll.objects(None)
                self._until = time.monotonic() + FRESH
                self._known = (
                    None
                    if found is None
                    else {str(each["metadata"]["name"]): each["metadata"].get("labels") or {} for each in found}
                )
            return self._known
