"""/metrics, /healthz and /readyz over HTTP, in the manager's own event loop: one that hangs does not answer."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from aiohttp import web

from application_manager.connection import ConfigurationError
from application_manager.measures import Measures

STALLED_AFTER = 300.0
"""Seconds without the end of a resync, at the least, after which the manager counts as stalled."""

_RESYNCS = 3  # and so many times the time between two

Lack = Callable[[], str | None]
"""What is lacking, in words; None where nothing is."""

_TEXT = "text/plain; version=0.0.4; charset=utf-8"


def stalled(measures: Measures, every: float) -> Lack:
    """Whether no resync has ended for long; one that fails, the API server being away, ends as well."""

    def look() -> str | None:
        since = time.monotonic() - measures.looked
        limit = max(STALLED_AFTER, _RESYNCS * every)
        return f"no resync has ended for {since:.0f} s" if since > limit else None

    return look


@asynccontextmanager
async def pages(port: int | None, measures: Measures, healthy: Lack, ready: Lack) -> AsyncIterator[int | None]:
    """Serve on all addresses while the block runs; the port, None where none is wanted. Port 0 takes a free one.

    Raises ConfigurationError where the port is taken.
    """
    if port is None:
        yield None
        return
    application = web.Application()

    async def metrics(_: web.Request) -> web.Response:
        return _answer(measures.text())

    async def healthz(_: web.Request) -> web.Response:
        return _judged(healthy())

    async def readyz(_: web.Request) -> web.Response:
        return _judged(healthy() or ready())

    for path, page in (("/metrics", metrics), ("/healthz", healthz), ("/readyz", readyz)):
        application.router.add_get(path, page)
    runner = web.AppRunner(application, access_log=None, handle_signals=False, shutdown_timeout=1)
    await runner.setup()
    try:
        try:
            await web.TCPSite(runner, port=port).start()
        except OSError as error:
            reason = error.strerror or error
            raise ConfigurationError(f"--metrics-port {port}: {reason}: give another port") from error
        # With port 0, IPv6 has a port of its own; an IPv4 address is a pair.
        yield next(int(each[1]) for each in sorted(runner.addresses, key=len))
    finally:
        await runner.cleanup()


def _answer(text: bytes, status: int = 200) -> web.Response:
    return web.Response(body=text, status=status, headers={"Content-Type": _TEXT})


def _judged(lack: str | None) -> web.Response:
    return _answer(b"ok\n" if lack is None else f"{lack}\n".encode(), 200 if lack is None else 503)
