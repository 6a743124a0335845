"""The last check before a write is sent: whether this manager is still active.

Between the first check and the sending a connection is opened, and a process may be stopped for any time. So the check
is repeated where the bytes are handed to the socket, in one go with that.

What is left are the microseconds between that look and the system call: a process that is stopped just there, for
longer than it may act, sends this one write when it continues. No client can exclude that. The active manager then sees
what came of it, and puts it right like anything else that nobody demands.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

import aiohttp

writing: ContextVar[Callable[[], float] | None] = ContextVar("writing", default=None)
"""Set while a write is sent: for how many seconds it may be. A request that only reads leaves it None."""


class FencedRequest(aiohttp.ClientRequest):
    """A request that is not sent once its time is over; it fails like one whose connection broke."""

    async def send(self, conn: Any) -> aiohttp.ClientResponse:
        """Send it. Raises ClientConnectionError where its time is over."""
        if _over():
            raise aiohttp.ClientConnectionError(_REASON)
        return await super().send(conn)

    async def write_bytes(self, writer: Any, conn: Any, content_length: int | None = None) -> None:
        """Write headers and body, unless its time is over."""
        if _over():
            conn.protocol.set_exception(aiohttp.ClientConnectionError(_REASON))
            conn.close()
            return
        await super().write_bytes(writer, conn, content_length)


_REASON = "this manager is no longer active"


def _over() -> bool:
    remaining = writing.get()
    return remaining is not None and remaining() <= 0
