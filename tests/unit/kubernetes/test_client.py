"""The client bounds concurrent requests, waits on the API server's request, and writes only while it is active."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import pytest
from aiohttp import web
from kubernetes.aio.client import Configuration

from application_manager.cluster.client import manager_client
from wayside.kubernetes import fence
from wayside.kubernetes.client import Client
from wayside.kubernetes.errors import ApiError, NotActive, Unreachable
from wayside.kubernetes.pacing import Pacing
from wayside.kubernetes.resources import LEASES

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
BODY = {"metadata": {"namespace": "n", "name": "x", "resourceVersion": "1"}}


@asynccontextmanager
async def serving(
    handle: Handler, may_act: Callable[[], float] | None = None, **arguments: object
) -> AsyncIterator[Client]:
    application = web.Application()
    application.router.add_route("*", "/{rest:.*}", handle)
    runner = web.AppRunner(application, handle_signals=False, shutdown_timeout=0.1)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    configuration = Configuration(host=f"http://127.0.0.1:{runner.addresses[0][1]}")
    client = manager_client(configuration, **arguments)  # type: ignore[arg-type]
    client.may_act = may_act or client.may_act
    try:
        yield client
    finally:
        await client.close()
        await runner.cleanup()


def refused(code: int, seconds: int | None) -> web.Response:
    headers = {} if seconds is None else {"Retry-After": str(seconds)}
    return web.json_response({"message": "later"}, status=code, headers=headers)


@pytest.mark.parametrize("code", [429, 503])
def test_rejected_requests_are_resent_after_retry_after_and_none_is_sent_meanwhile(code: int) -> None:
    came: list[float] = []

    async def handle(_: web.Request) -> web.Response:
        came.append(time.monotonic())
        return refused(code, 1) if len(came) == 1 else web.json_response({})

    async def scenario() -> None:
        pacing = Pacing()
        async with serving(handle, pacing=pacing) as client:
            first = asyncio.create_task(client.get(LEASES, "n", "first"))
            while not came:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
            while not pacing.held and not first.done():  # noqa: ASYNC110  until the refusal has arrived
                await asyncio.sleep(0.01)
            await asyncio.gather(first, *(client.get(LEASES, "n", f"other-{index}") for index in range(10)))

    asyncio.run(scenario())
    assert len(came) == 12
    assert came[1] - came[0] >= 1.0


def test_a_rejection_without_retry_after_is_raised_to_the_caller() -> None:
    async def handle(_: web.Request) -> web.Response:
        return refused(503, None)

    async def scenario() -> None:
        async with serving(handle) as client:
            with pytest.raises(ApiError) as error:
                await client.get(LEASES, "n", "x")
            assert error.value.code == 503

    asyncio.run(scenario())


def test_an_api_server_that_always_requests_a_wait_is_reported_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wayside.kubernetes.client._PATIENCE", 1.5)

    async def handle(_: web.Request) -> web.Response:
        return refused(429, 1)

    async def scenario() -> None:
        async with serving(handle) as client:
            with pytest.raises(ApiError) as error:
                await client.get(LEASES, "n", "x")
            assert error.value.retry_after == 1.0

    asyncio.run(scenario())


def test_concurrent_requests_are_bounded() -> None:
    under_way, most = 0, 0

    async def handle(_: web.Request) -> web.Response:
        nonlocal under_way, most
        under_way += 1
        most = max(most, under_way)
        await asyncio.sleep(0.02)
        under_way -= 1
        return web.json_response({})

    async def scenario() -> None:
        async with serving(handle, pacing=Pacing(3)) as client:
            await asyncio.gather(*(client.get(LEASES, "n", str(index)) for index in range(30)))

    asyncio.run(scenario())
    assert most == 3


def test_a_client_that_may_not_act_reads_but_does_not_write() -> None:
    methods: list[str] = []

    async def handle(request: web.Request) -> web.Response:
        methods.append(request.method)
        return web.json_response({})

    async def scenario() -> None:
        async with serving(handle, may_act=lambda: 0.0) as client:
            await client.get(LEASES, "n", "x")
            await client.review(LEASES, {})
            await client.apply(LEASES, BODY, dry_run=True)
            with pytest.raises(NotActive):
                await client.create(LEASES, BODY)

    asyncio.run(scenario())
    assert methods == ["GET", "POST", "PATCH"]


@pytest.mark.parametrize("looks", [1, 2])
def test_a_write_whose_deadline_passes_before_it_is_sent_is_not_sent(looks: int) -> None:
    """As if the process is suspended during a request and resumes when another one is active."""
    answers = [10.0] * looks
    methods: list[str] = []

    async def handle(request: web.Request) -> web.Response:
        methods.append(request.method)
        return web.json_response({})

    async def scenario() -> None:
        async with serving(handle, may_act=lambda: answers.pop() if answers else 0.0) as client:
            with pytest.raises(Unreachable, match="no longer active"):
                await client.replace(LEASES, BODY)
            await client.get(LEASES, "n", "x")

    asyncio.run(scenario())
    assert methods == ["GET"]
    assert fence.writing.get() is None


def test_a_write_is_aborted_at_its_deadline_which_the_api_server_knows() -> None:
    queries: list[str] = []

    async def handle(request: web.Request) -> web.Response:
        queries.append(request.query["timeout"])
        await asyncio.sleep(60)
        return web.json_response({})

    async def scenario() -> None:
        async with serving(handle, may_act=lambda: 2.0) as client:
            with pytest.raises(Unreachable):
                await client.replace(LEASES, BODY)
            assert client.open_until > 0

    asyncio.run(scenario())
    assert queries == ["2000ms"]


def test_missing_rights_are_reported_with_the_remedy() -> None:
    text = 'leases "x" is forbidden: User "system:serviceaccount:n:m" cannot get resource "leases" in API group "c"'

    async def handle(_: web.Request) -> web.Response:
        return web.json_response({"message": text}, status=403)

    async def scenario() -> None:
        async with serving(handle) as client:
            with pytest.raises(ApiError, match="apply the output of `application-manager rbac`"):
                await client.get(LEASES, "n", "x")

    asyncio.run(scenario())
