"""Pauses between attempts grow, are jittered, and start over."""

from __future__ import annotations

from wayside.process.backoff import Backoff


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
