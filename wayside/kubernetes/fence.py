"""The last check before a write is sent: whether this manager is still active.

Between the first check and the sending of the request, a connection is opened, and the process may be suspended for any
time. So the check is repeated immediately before the bytes are passed to the socket.

Only the microseconds between this check and the system call remain: a process that is suspended there for longer than
it may act sends this one write when it continues. No client can exclude that. The active manager then observes the
result, and corrects it like any other object that nobody demands.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

import aiohttp

writing: ContextVar[Callable[[], float] | None] = ContextVar("writing", default=None)
"""During a write: returns the number of seconds for which it may be sent. None during a read."""


class FencedRequest(aiohttp.ClientRequest):
    """A request that is not sent after its time is over. It fails like one whose connection broke."""

    async def send(self, conn: Any) -> aiohttp.ClientResponse:
        """Send the request. Raises ClientConnectionError if its time is over."""
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
