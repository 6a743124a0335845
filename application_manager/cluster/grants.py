"""In which namespaces the account may write, for a manager of all namespaces.

By its ClusterRole it may read everywhere. It writes where an administrator binds it to the role that allows writing
(`application-manager rbac --grant`). What happens in other namespaces is seen and left alone: a request for each object
there, refused each time, would be a load without an end.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from application_manager.cluster.entitlement import may
from application_manager.core.objects.rights import granting
from wayside.kubernetes.client import Client
from wayside.kubernetes.repeating import repeatedly

LOOK_EVERY = 5.0  # s between two questions about a namespace, while something is to be written there

log = logging.getLogger(__name__)


class Grants:
    """Queries the API server once for each namespace, and again while the answer is no."""

    def __init__(self, client: Client, changed: Callable[[], None]) -> None:
        """Prepare.

        Args:
            client: for the API server.
            changed: called when the account may write in a namespace in which it was not allowed to before.
        """
        self._client = client
        self._changed = changed
        self._granted: set[str] = set()
        self._refused: set[str] = set()
        self._asking = asyncio.Lock()

    async def may_write(self, namespace: str) -> bool:
        """Whether the account may write in the namespace. Raises ApiError or Unreachable where nobody answers."""
        async with self._asking:
            if namespace not in self._granted | self._refused and not await self._is_granted(namespace):
                self._refused.add(namespace)
                log.warning(
                    "namespace %s is not granted to this manager, which ignores it: apply the output of "
                    "`application-manager rbac --grant %s`, or add it to manager.grant of the chart",
                    namespace,
                    namespace,
                )
        return namespace in self._granted

    async def run(self) -> None:
        """Check the namespaces that are not granted again and again, until cancelled."""
        await repeatedly(self._look, LOOK_EVERY, "")  # the look at its health reports that the API server is away

    async def _look(self) -> None:
        granted = [each for each in sorted(self._refused) if await self._is_granted(each)]
        if granted:
            log.info("namespace %s is granted to this manager", ", ".join(granted))
            self._refused.difference_update(granted)
            self._changed()

    async def _is_granted(self, namespace: str) -> bool:
        right = granting()
        if await may(self._client, right, right.verbs[0], namespace):
            self._granted.add(namespace)
            return True
        return False
