"""A look at the cluster's nodes, where the account may list them: it shows what the scheduler does not report.

Nodes are not watched: they matter only while an application that is bound to some of them does not become ready.
"""

from __future__ import annotations

import asyncio
import logging
import time

from application_manager.core.health.placement import Nodes
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, Unreachable
from wayside.kubernetes.resources import Resource

NODES = Resource("v1", "Node", "nodes", namespaced=False)
FRESH = 2.0  # s for which an answer is used again
FORBIDDEN_FOR = 60.0  # s until nodes are listed again

log = logging.getLogger(__name__)


class NodeLook:
    """The labels of all nodes, a few seconds old at most."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._known: Nodes | None = None
        self._until = 0.0  # monotonic time until which what is known is used
        self._told = False
        self._asking = asyncio.Lock()

    async def labels(self) -> Nodes | None:
        """The labels of nodes by name; None where they may not be listed, or the API server does not answer."""
        async with self._asking:
            if time.monotonic() >= self._until:
                self._known = await self._listed()
            return self._known

    async def _listed(self) -> Nodes | None:
        try:
            found, _ = await self._client.list(NODES, None)
        except ApiError as error:
            self._until = time.monotonic() + (FORBIDDEN_FOR if error.code == 403 else FRESH)
            if not self._told:
                log.info("cannot list nodes (%s): only the scheduler reports why a pod fits no node", error)
                self._told = True
            return None
        except Unreachable:
            return None
        self._until = time.monotonic() + FRESH
        return {str(each["metadata"]["name"]): each["metadata"].get("labels") or {} for each in found}
