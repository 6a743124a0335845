"""The manager's client for the API server."""

from __future__ import annotations

from kubernetes.aio.client import Configuration

from application_manager.core.objects.ownership import FIELD_MANAGER
from application_manager.core.objects.rights import REMEDY
from application_manager.measures import Measures
from wayside.kubernetes.client import Client
from wayside.kubernetes.pacing import Pacing


def manager_client(
    configuration: Configuration,
    measures: Measures | None = None,
    *,
    pacing: Pacing | None = None,
    timeout: float = 15.0,
) -> Client:
    """A client with a rate limit that writes as the manager; `timeout`: seconds for one request."""
    return Client(
        configuration,
        "wayside-application-manager",
        field_manager=FIELD_MANAGER,
        remedy=REMEDY,
        measure=measures.requested if measures else None,
        pacing=pacing or Pacing(),
        timeout=timeout,
    )
