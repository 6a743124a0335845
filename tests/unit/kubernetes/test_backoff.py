"""Pauses between attempts grow, are jittered, and start over."""

from __future__ import annotations

import pytest

from wayside.process.backoff import Backoff, retry


def test_delays_double_up_to_the_cap_and_start_over_after_a_success() -> None:
    backoff = Backoff(first=1.0, cap=5.0)
    for most in (1.0, 2.0, 4.0, 5.0, 5.0):
        assert most / 2 <= backoff.fail() <= most
    for _ in range(5000):
        assert backoff.fail() <= 5.0
    backoff.succeed()
    assert backoff.fail() <= 1.0


def test_a_wait_that_the_server_requests_is_kept_up_to_the_cap() -> None:
    assert Backoff(first=0.1, cap=5.0).fail(at_least=3.0) == 3.0
    assert Backoff(first=0.1, cap=5.0).fail(at_least=600.0) == 5.0


def test_an_attempt_is_repeated_until_it_succeeds_and_after_the_pause_that_its_failure_requests() -> None:
    failures, pauses = [KeyError("one"), KeyError("two")], list[float]()

    def attempt() -> str:
        if failures:
            raise failures.pop(0)
        return "done"

    assert retry(attempt, KeyError, lambda error: 1.0 if error.args == ("one",) else 2.0, pauses.append) == "done"
    assert pauses == [1.0, 2.0]


def test_an_unexpected_error_is_raised_at_once() -> None:
    def attempt() -> None:
        raise ValueError("a defect")

    with pytest.raises(ValueError, match="a defect"):
        retry(attempt, KeyError, lambda _: 0.0)
