"""What the API server answers, sorted by what to do about it."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from detector.cluster.api import Resource
from detector.cluster.connection import connect
from detector.cluster.errors import (
    AlreadyExistsError,
    ApiError,
    ConflictError,
    GoneError,
    NoClusterError,
    NotFoundError,
    RefusedError,
    UnavailableError,
    error_of,
)


@pytest.mark.parametrize(
    ("code", "reason", "kind"),
    [
        (400, "BadRequest", RefusedError),
        (401, "Unauthorized", UnavailableError),
        (403, "Forbidden", RefusedError),
        (404, "NotFound", NotFoundError),
        (409, "AlreadyExists", AlreadyExistsError),
        (409, "Conflict", ConflictError),
        (410, "Expired", GoneError),
        (422, "Invalid", RefusedError),
        (429, "TooManyRequests", UnavailableError),
        (500, "InternalError", UnavailableError),
        (503, "ServiceUnavailable", UnavailableError),
    ],
)
def test_each_answer_is_its_kind_of_error(code: int, reason: str, kind: type[ApiError]) -> None:
    error = error_of(code, json.dumps({"reason": reason, "message": "so it is"}).encode())
    assert type(error) is kind
    assert (error.code, error.reason, str(error)) == (code, reason, f"{code} {reason}: so it is")


@pytest.mark.parametrize("body", [b"<html>bad gateway</html>", b"", b"[1]", b"\xff", b'"text"'])
def test_an_answer_that_is_no_status_is_still_an_error(body: bytes) -> None:
    assert type(error_of(502, body)) is UnavailableError


def test_a_wait_that_the_server_asks_for_is_kept() -> None:
    error = error_of(429, b"{}", "7")
    assert isinstance(error, UnavailableError)
    assert error.retry_after == 7.0


def test_paths_of_core_and_other_groups() -> None:
    assert Resource("v1", "pods").path("ns", "p") == "/api/v1/namespaces/ns/pods/p"
    assert (
        Resource("wayside.dev/v1alpha1", "detectors").path("ns") == "/apis/wayside.dev/v1alpha1/namespaces/ns/detectors"
    )


@pytest.mark.parametrize("content", [None, "{}", "clusters: [", "just text"])
def test_a_missing_or_broken_kubeconfig_is_said_with_the_remedy(tmp_path: Path, content: str | None) -> None:
    file = tmp_path / "kubeconfig"
    if content is not None:
        file.write_text(content)

    async def open_it() -> None:
        async with connect(kubeconfig=file, otherwise="do without"):
            pass

    with pytest.raises(NoClusterError, match=r"Set KUBECONFIG .*; or do without$"):
        asyncio.run(open_it())
