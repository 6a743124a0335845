"""Resolves names to addresses, in threads that are never joined.

The system's resolver cannot be interrupted. On a vehicle without a network it hangs for many seconds, and the process
waits at its end for the threads of an executor, but not for these.
"""

from __future__ import annotations

import asyncio
import socket
import threading

from aiohttp.abc import AbstractResolver, ResolveResult


class Resolver(AbstractResolver):
    """Queries the system, in a daemon thread per query."""

    async def resolve(
        self, host: str, port: int = 0, family: socket.AddressFamily = socket.AF_UNSPEC
    ) -> list[ResolveResult]:
        """The host's addresses. Raises OSError if there are none."""
        loop = asyncio.get_running_loop()
        found: asyncio.Future[list[ResolveResult]] = loop.create_future()

        def look_up() -> None:
            try:
                answer: list[ResolveResult] | OSError = _addresses(host, port, family)
            except (OSError, UnicodeError) as error:
                answer = error if isinstance(error, OSError) else OSError(f"{host!r} is not a host name")
            try:
                loop.call_soon_threadsafe(_settle, found, answer)
            except RuntimeError:  # the loop is closed: nothing waits any more
                return

        threading.Thread(target=look_up, name=f"resolve {host}", daemon=True).start()
        return await found

    async def close(self) -> None:
        """There is nothing to close."""


def _addresses(host: str, port: int, family: socket.AddressFamily) -> list[ResolveResult]:
    return [
        ResolveResult(
            hostname=host, host=str(address[0]), port=port, family=kind, proto=protocol, flags=socket.AI_NUMERICHOST
        )
        for kind, _, protocol, _, address in socket.getaddrinfo(host, port, family, socket.SOCK_STREAM)
    ]


def _settle(found: asyncio.Future[list[ResolveResult]], answer: list[ResolveResult] | OSError) -> None:
    if found.done():
        return
    if isinstance(answer, OSError):
        found.set_exception(answer)
    else:
        found.set_result(answer)
