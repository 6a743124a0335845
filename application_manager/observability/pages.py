"""Serves /metrics, /healthz and /readyz over HTTP(S), in the event loop: if that hangs, they do not respond."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Protocol

from aiohttp import web

from application_manager.measures import Measures
from wayside.kubernetes.connection import ConfigurationError
from wayside.process.servingcertificate import ServingCertificate

FOLDER_OPTION = "--metrics-certificates"

STALLED_AFTER = 300.0
"""The minimum number of seconds without a finished resync after which the manager counts as stalled."""

_RESYNCS = 3  # and this multiple of the resync interval

Problem = Callable[[], str | None]
"""Why the manager is not ready, as text; None if it is ready."""

_TEXT = "text/plain; version=0.0.4; charset=utf-8"


class _Queue(Protocol):
    """Reports a worker that processes one key for too long."""

    def stuck(self, limit: float) -> str | None:
        """The key and the time, as text."""


def stalled(measures: Measures, every: float, queues: Sequence[_Queue] = (), least: float = STALLED_AFTER) -> Problem:
    """Reports stalled work: no resync has ended, or a worker processes one key, for too long. Any thread may call it.

    A resync that fails because the API server is unreachable counts as ended. `every`: seconds between two resyncs;
    `least`: the minimum limit in seconds; the limit is three times `every` if that is more.
    """
    limit = max(least, _RESYNCS * every)

    def check() -> str | None:
        stuck = next(filter(None, (queue.stuck(limit) for queue in queues)), None)
        if stuck is not None:
            return stuck
        since = time.monotonic() - measures.last_resync
        return f"no resync has completed for {since:.0f} s" if since > limit else None

    return check


@asynccontextmanager
async def pages(
    port: int | None,
    measures: Measures,
    healthy: Problem,
    ready: Problem,
    role: Callable[[], str] = str,
    certificates: Path | None = None,
) -> AsyncIterator[int | None]:
    """Serve on all addresses while the block runs; yields the port, or None if `port` is None. Port 0 takes a free one.

    `role`: what /readyz adds to "ok", if anything: a standby is ready as well. `certificates`: the folder with tls.crt
    and tls.key, which may change; None: without TLS. Raises ConfigurationError if the port is in use, CertificateError
    if there is no valid certificate.
    """
    if port is None:
        yield None
        return
    certificate = None if certificates is None else ServingCertificate(certificates, FOLDER_OPTION)
    application = web.Application()

    async def metrics(_: web.Request) -> web.Response:
        return _response(measures.text())

    async def healthz(_: web.Request) -> web.Response:
        return _health_response(healthy())

    async def readyz(_: web.Request) -> web.Response:
        return _health_response(healthy() or ready(), role())

    for path, page in (("/metrics", metrics), ("/healthz", healthz), ("/readyz", readyz)):
        application.router.add_get(path, page)
    runner = web.AppRunner(application, access_log=None, handle_signals=False, shutdown_timeout=1)
    await runner.setup()
    following = None if certificate is None else asyncio.create_task(certificate.follow(), name="metrics certificate")
    try:
        try:
            await web.TCPSite(runner, port=port, ssl_context=certificate.context if certificate else None).start()
        except OSError as error:
            reason = error.strerror or error
            raise ConfigurationError(f"--metrics-port {port}: {reason}: give another port") from error
        # With port 0, IPv6 has its own port; an IPv4 address is a pair.
        yield next(int(each[1]) for each in sorted(runner.addresses, key=len))
    finally:
        if following is not None:
            following.cancel()
            await asyncio.gather(following, return_exceptions=True)
        await runner.cleanup()


def _response(text: bytes, status: int = 200) -> web.Response:
    return web.Response(body=text, status=status, headers={"Content-Type": _TEXT})


def _health_response(problem: str | None, role: str = "") -> web.Response:
    text = problem or ", ".join(filter(None, ("ok", role)))
    return _response(f"{text}\n".encode(), 200 if problem is None else 503)
