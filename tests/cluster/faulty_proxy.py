"""A proxy in front of the API server that simulates network failures and loaded servers for one program.

It speaks plain HTTP on loopback and forwards everything, including watches, with the program's own credentials. The
test's thread can set the failures and read the seen requests at any time.
"""

from __future__ import annotations

import asyncio
import ssl
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import aiohttp
import yaml
from aiohttp import web

from tests.patience import PATIENCE

_HOP = frozenset({"connection", "content-length", "content-encoding", "host", "keep-alive", "transfer-encoding"})


@dataclass
class ProxiedRequest:
    """One request: its monotonic time and the status of its answer (0: none yet).

    `refused`: whether the proxy rejected it; the API server may answer with the same status.
    """

    method: str
    path: str
    at: float
    status: int = 0
    refused: bool = False


@dataclass
class Proxy:
    """The settings of the proxy and the requests that it has seen.

    Attributes:
        cut: no data passes: requests get no answer, and open watches break.
        refuse: for a request, the status and Retry-After (seconds) of the answer; None forwards the request.
        seen: all requests.
        most: the maximum number of concurrent requests so far, without watches.
    """

    url: str = ""
    cut: bool = False
    refuse: Callable[[str, str], tuple[int, int] | None] = lambda _method, _path: None
    seen: list[ProxiedRequest] = field(default_factory=list)
    most: int = 0
    under_way: int = 0
    slow: float = 0.0  # s that every answer is delayed
    hushed: frozenset[int] = frozenset()  # indexes in `seen` of watches whose connection is open but silent

    def writes(self) -> list[ProxiedRequest]:
        """The requests that change any object but a Lease; access reviews change nothing."""
        others = ("/leases", "/selfsubjectaccessreviews")
        return [each for each in self.seen if each.method != "GET" and not any(other in each.path for other in others)]

    def lease_writes(self) -> list[ProxiedRequest]:
        """The answered requests that changed a Lease."""
        return [each for each in self.seen if each.method != "GET" and "/leases" in each.path and each.status]


@contextmanager
def faulty_proxy(kubeconfig: Path) -> Iterator[tuple[Proxy, Path]]:
    """Run a proxy in a thread, in front of the kubeconfig's API server; yields it and a kubeconfig for it."""
    written = yaml.safe_load(kubeconfig.read_text())
    target = written["clusters"][0]["cluster"]["server"]
    proxy, loop = Proxy(), asyncio.new_event_loop()
    ready, over = threading.Event(), asyncio.Event()
    thread = threading.Thread(target=lambda: loop.run_until_complete(_serve(proxy, target, ready, over)), name="proxy")
    thread.start()
    try:
        assert ready.wait(PATIENCE)
        written["clusters"][0]["cluster"] = {"server": proxy.url}
        mine = kubeconfig.with_name(f"kubeconfig-proxy-{proxy.url.rpartition(':')[2]}")
        mine.touch(mode=0o600)
        mine.write_text(yaml.safe_dump(written))
        yield proxy, mine
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join()
        loop.close()


async def _serve(proxy: Proxy, target: str, ready: threading.Event, over: asyncio.Event) -> None:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    connector = aiohttp.TCPConnector(ssl=context, limit=0)
    async with aiohttp.ClientSession(connector=connector, auto_decompress=False) as session:

        async def handle(request: web.Request) -> web.StreamResponse:
            seen = ProxiedRequest(request.method, request.path_qs, time.monotonic())
            index = len(proxy.seen)
            proxy.seen.append(seen)
            watches = "watch=true" in request.path_qs
            proxy.under_way += not watches
            proxy.most = max(proxy.most, proxy.under_way)
            try:
                return await _answer(proxy, session, target, request, seen, index)
            finally:
                proxy.under_way -= not watches

        application = web.Application(client_max_size=2**24)
        application.router.add_route("*", "/{rest:.*}", handle)
        runner = web.AppRunner(
            application, access_log=None, handle_signals=False, shutdown_timeout=0.1, handler_cancellation=True
        )
        await runner.setup()
        try:
            await web.TCPSite(runner, "127.0.0.1", 0).start()
            proxy.url = f"http://127.0.0.1:{runner.addresses[0][1]}"
            ready.set()
            await over.wait()
        finally:
            await runner.cleanup()


async def _answer(
    proxy: Proxy, session: aiohttp.ClientSession, target: str, request: web.Request, seen: ProxiedRequest, index: int
) -> web.StreamResponse:
    await _while_cut(proxy)
    refusal = proxy.refuse(request.method, request.path_qs)
    if refusal is not None:
        seen.status, seconds = refusal
        seen.refused = True
        status = {
            "kind": "Status",
            "apiVersion": "v1",
            "code": seen.status,
            "message": "too many requests, please wait",
        }
        return web.json_response(status, status=seen.status, headers={"Retry-After": str(seconds)})
    if proxy.slow:
        await asyncio.sleep(proxy.slow)
    headers = {key: value for key, value in request.headers.items() if key.lower() not in _HOP}
    body = await request.read() or None
    async with session.request(request.method, target + request.path_qs, headers=headers, data=body) as answer:
        kept = {key: value for key, value in answer.headers.items() if key.lower() not in _HOP | {"content-encoding"}}
        encoding = answer.headers.get("Content-Encoding")
        response = web.StreamResponse(
            status=answer.status, headers=kept | ({"Content-Encoding": encoding} if encoding else {})
        )
        await _while_cut(proxy)
        await response.prepare(request)
        async for chunk in _chunks(proxy, answer):
            if index not in proxy.hushed:
                await response.write(chunk)
        seen.status = answer.status
        await response.write_eof()
        return response


async def _chunks(proxy: Proxy, answer: aiohttp.ClientResponse) -> AsyncIterator[bytes]:
    """The body in the chunks received; breaks when the network is cut."""
    reading = asyncio.ensure_future(answer.content.readany())
    try:
        while True:
            await asyncio.wait({reading}, timeout=0.1)
            if proxy.cut:
                raise ConnectionResetError("the network is cut")
            if reading.done():
                chunk = reading.result()
                if not chunk:
                    return
                yield chunk
                reading = asyncio.ensure_future(answer.content.readany())
    finally:
        reading.cancel()


async def _while_cut(proxy: Proxy) -> None:
    while proxy.cut:  # noqa: ASYNC110  another thread sets it
        await asyncio.sleep(0.05)
