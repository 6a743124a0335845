"""The manager starts as soon as the API server permits, and gives up only on permanent errors."""

from __future__ import annotations

import asyncio
import logging

import pytest

from wayside.kubernetes.errors import ApiError, Unreachable
from wayside.kubernetes.retrying import repeatedly, until_answered


def requested(*failures: Exception) -> str:
    """The answer of what fails in these ways first."""
    left = list(failures)

    async def ask() -> str:
        if left:
            raise left.pop(0)
        return "answer"

    return asyncio.run(until_answered(ask, pause=0.0))


def test_an_api_server_that_is_away_or_overloaded_is_waited_for_and_it_is_reported_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    failures = [
        Unreachable("GET /apis: refused"),
        ApiError(503, "starting"),
        ApiError(429, "too many requests"),
        ApiError(500, "etcd"),
    ]
    assert requested(*failures) == "answer"
    assert [record.getMessage() for record in caplog.records] == [
        "GET /apis: refused; retrying until the API server responds",
        "the API server responds",
    ]


@pytest.mark.parametrize("code", [401, 403, 400])
def test_permanent_errors_are_reported_at_once(code: int) -> None:
    with pytest.raises(ApiError, match="no"):
        requested(ApiError(code, "no"))


def test_an_immediate_answer_is_not_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    assert requested() == "answer"
    assert caplog.records == []


def test_each_repeated_request_waits_as_long_as_an_overloaded_api_server_requests(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pauses: list[float] = []
    failures = [ApiError(429, "too many", retry_after=30.0), ApiError(503, "starting"), Unreachable("refused")]
    left = iter([*failures, *failures])

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    async def look() -> None:
        raise next(left, asyncio.CancelledError())

    monkeypatch.setattr(asyncio, "sleep", sleep)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(repeatedly(look, 5.0, ""))
    assert pauses == [30.0, 5.0, 5.0] * 2
