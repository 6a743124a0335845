"""The meaning of an endpoint's response: done, retry, or final failure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from enum import Enum

_AGAIN = frozenset({408, 425, 429})
"""Refusals that are temporary and not about the request (RFC 9110, RFC 8470, RFC 6585)."""

_BUSY = frozenset({429, 502, 503, 504})
"""Responses of an endpoint that is busy, whatever the request."""


class ResponseOutcome(Enum):
    """What a response means for the request."""

    DONE = "done"
    AGAIN = "again"
    """Worth another attempt."""
    FINAL = "final"
    """The same request would be refused again."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The response of an endpoint."""

    status: int
    body: bytes = b""
    """At most the requested number of bytes."""
    whole: bool = True
    """Whether the body ended as announced, within the requested number of bytes."""
    headers: Mapping[str, str] | None = None
    """By lower-case name."""
    excerpt: str = ""
    """Of a refusal, its beginning, with secrets of the request removed."""

    @property
    def retry_after(self) -> str:
        """The header of that name, or an empty text."""
        return (self.headers or {}).get("retry-after", "")

    @property
    def busy(self) -> bool:
        """Whether the whole endpoint requests a pause."""
        return self.status in _BUSY


def judge(answer: Answer) -> tuple[ResponseOutcome, str]:
    """The outcome, and a reason for users."""
    if 200 <= answer.status < 300:
        return ResponseOutcome.DONE, f"answered {answer.status}"
    response = f"answered {answer.status}" + (f": {answer.excerpt}" if answer.excerpt else "")
    if 300 <= answer.status < 400:
        return ResponseOutcome.FINAL, f"{response}: redirects are not followed: give the new URL"
    if answer.status in _AGAIN or answer.status >= 500:
        return ResponseOutcome.AGAIN, response
    return ResponseOutcome.FINAL, response


def retry_after_seconds(retry_after: str, now: float) -> float:
    """The seconds of a Retry-After header, in either of its forms (RFC 9110, section 10.2.3).

    Args:
        retry_after: the header's value, perhaps empty.
        now: seconds since the epoch.

    Returns:
        0 if it cannot be parsed.
    """
    text = retry_after.strip()
    if text.isascii() and text.isdigit():
        return float(min(int(text[:9]), 86_400))
    try:
        when = parsedate_to_datetime(text)
    except (ValueError, IndexError, TypeError):
        return 0.0
    if when.tzinfo is None:
        when = when.replace(tzinfo=UTC)
    return min(max(0.0, (when - datetime.fromtimestamp(now, UTC)).total_seconds()), 86_400.0)
