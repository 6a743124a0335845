"""A holder's Lease when the API server does not respond."""

from __future__ import annotations

import asyncio
from typing import Any

from detector.actions.deploy.lease import HolderLease, ProcessIdentity
from tests.unit.actions.test_deploy import eventually
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import Unreachable


class Server:
    """An API server with one Lease, which can stop to respond."""

    def __init__(self) -> None:
        self.responds = True
        self.lease: dict[str, Any] | None = None

    async def get(self, *_: object) -> dict[str, Any] | None:
        self._check()
        return self.lease

    async def create(self, _: object, body: dict[str, Any]) -> dict[str, Any]:
        self._check()
        self.lease = body
        return body

    replace = create

    def _check(self) -> None:
        if not self.responds:
            raise Unreachable("no route to host")


def test_a_holder_that_cannot_renew_changes_no_tasks_once_its_lease_has_expired() -> None:
    async def drive() -> None:
        now, server = 100.0, Server()
        client: Client = server  # type: ignore[assignment]
        lease = HolderLease(client, "site", "town", ProcessIdentity("pod-1"), duration=3.0, monotonic=lambda: now)
        running = asyncio.create_task(lease.run())
        await eventually(lease.held.is_set, "it holds the Lease")
        server.responds = False
        before = lease.failures
        await eventually(lambda: lease.failures >= before + 2, "renewals have failed")
        assert lease.held.is_set(), "no other process can hold it yet"
        now += 3.0
        await eventually(lambda: not lease.held.is_set(), "it has expired")
        server.responds = True
        await eventually(lease.held.is_set, "it is renewed")
        lease.stop()
        await running

    asyncio.run(drive())
