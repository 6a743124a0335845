"""A look at the Events about a workload whose pods cannot be made, where its own status does not give the reason.

They are not watched: a cluster has many Events, and these matter only while pods are missing.
"""

from __future__ import annotations

import logging
import time

from application_manager.core.health.refusals import FAILED_CREATE
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, Unreachable
from wayside.kubernetes.resources import EVENTS, Object

FORBIDDEN_FOR = 60.0  # s until Events are listed again
_NEWEST = 50  # Events of one workload that are read; their number is bounded by the API server keeping them for an hour

log = logging.getLogger(__name__)


class FailedPodsLook:
    """The Events FailedCreate of workloads."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._forbidden_until = 0.0  # monotonic
        self._told = False

    async def events(self, namespace: str, uid: str) -> list[Object]:
        """Those of the object with this uid; none where they may not be listed, or the API server does not answer."""
        if time.monotonic() < self._forbidden_until:
            return []
        try:
            found, _ = await self._client.list(
                EVENTS, namespace, fields=f"regarding.uid={uid},reason={FAILED_CREATE}", limit=_NEWEST
            )
        except ApiError as error:
            if error.code == 403:
                self._forbidden_until = time.monotonic() + FORBIDDEN_FOR
            if not self._told:
                log.info(
                    "cannot list Events (%s): statuses do not give the reason why pods of a StatefulSet cannot be "
                    "created",
                    error,
                )
                self._told = True
            return []
        except Unreachable:
            return []
        return found
