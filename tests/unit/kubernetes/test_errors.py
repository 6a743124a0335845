"""Responses of the API server, classified by the reaction to them."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from aiohttp import web
from kubernetes.aio.client import Configuration

from wayside.kubernetes.client import Client
from wayside.kubernetes.connection import ConfigurationError, connect
from wayside.kubernetes.errors import ApiError
from wayside.kubernetes.pacing import LONGEST_HOLD
from wayside.kubernetes.resources import Resource

PODS = Resource("v1", "Pod", "pods")


@asynccontextmanager
async def answering(response: web.Response) -> AsyncIterator[Client]:
    async def answer(_: web.Request) -> web.Response:
        return response

    application = web.Application()
    application.router.add_route("*", "/{rest:.*}", answer)
    runner = web.AppRunner(application, handle_signals=False, shutdown_timeout=0.1)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    client = Client(Configuration(host=f"http://127.0.0.1:{runner.addresses[0][1]}"), "test", field_manager="test")
    try:
        yield client
    finally:
        await client.close()
        await runner.cleanup()


def error_of(response: web.Response) -> ApiError:
    async def scenario() -> ApiError:
        async with answering(response) as client:
            with pytest.raises(ApiError) as caught:
                await client.create(PODS, {"metadata": {"namespace": "n"}})
            return caught.value

    return asyncio.run(scenario())


@pytest.mark.parametrize(
    ("code", "reason", "permanent"),
    [
        (400, "BadRequest", True),
        (401, "Unauthorized", False),
        (403, "Forbidden", True),
        (404, "NotFound", True),
        (409, "AlreadyExists", False),
        (409, "Conflict", False),
        (410, "Expired", True),
        (422, "Invalid", True),
        (429, "TooManyRequests", False),
        (500, "InternalError", False),
        (503, "ServiceUnavailable", False),
    ],
)
def test_each_response_maps_to_its_error_class(code: int, reason: str, permanent: bool) -> None:
    error = error_of(web.json_response({"reason": reason, "message": "so it is"}, status=code))
    assert (error.code, error.reason, error.permanent) == (code, reason, permanent)
    assert error.exists == (reason == "AlreadyExists")
    assert str(error) == f"so it is (HTTP {code})"


@pytest.mark.parametrize("body", [b"<html>bad gateway</html>", b"", b"[1]", b"\xff", b'"text"'])
def test_a_response_without_a_status_object_is_still_an_error(body: bytes) -> None:
    error = error_of(web.Response(body=body, status=502))
    assert (error.code, error.permanent) == (502, False)


def test_a_wait_that_the_server_requests_is_kept() -> None:
    assert error_of(web.json_response({}, status=429, headers={"Retry-After": "7"})).retry_after == 7.0


def test_a_wait_that_the_server_requests_is_bounded() -> None:
    response = web.json_response({}, status=503, headers={"Retry-After": "86400"})
    assert error_of(response).retry_after == LONGEST_HOLD


def test_paths_of_core_and_other_groups() -> None:
    assert PODS.path("ns", "p") == "/api/v1/namespaces/ns/pods/p"
    detectors = Resource("wayside.dev/v1alpha1", "Detector", "detectors")
    assert detectors.path("ns") == "/apis/wayside.dev/v1alpha1/namespaces/ns/detectors"


@pytest.mark.parametrize("content", [None, "{}", "clusters: [", "just text"])
def test_a_missing_or_broken_kubeconfig_is_reported_with_the_remedy(tmp_path: Path, content: str | None) -> None:
    file = tmp_path / "kubeconfig"
    if content is not None:
        file.write_text(content)

    async def open_it() -> None:
        async with connect("test", kubeconfig=file, otherwise="do without"):
            pass

    with pytest.raises(ConfigurationError, match=r"set KUBECONFIG .*; or do without$"):
        asyncio.run(open_it())
