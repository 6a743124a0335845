"""Times as RFC 3339 text and as integer nanoseconds since the epoch, without loss either way."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from functools import lru_cache

_SECOND = 1_000_000_000
_PATTERN = re.compile(
    r"(?P<whole>[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2})"
    r"(?:\.(?P<fraction>[0-9]{1,9}))?"
    r"(?P<zone>Z|[+-][0-9]{2}:[0-9]{2})"
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def format_time(ns: int) -> str:
    """The time in UTC, always with nine digits: ``2026-01-01T00:00:00.123456789Z``.

    Args:
        ns: nanoseconds since the epoch; years 1 to 9999.

    Raises:
        ValueError: the time is outside these years.
    """
    seconds, fraction = divmod(ns, _SECOND)
    try:
        return f"{_whole(seconds)}.{fraction:09}Z"
    except (OverflowError, OSError, ValueError) as error:
        raise ValueError(f"{ns} ns since the epoch is not a time in the years 1 to 9999") from error


@lru_cache(maxsize=256)  # times that are printed together mostly share few seconds
def _whole(seconds: int) -> str:
    """Up to the second: ``2026-01-01T00:00:00``."""
    return datetime.fromtimestamp(seconds, UTC).isoformat()[:19]


def parse_time(text: str) -> int:
    """Nanoseconds since the epoch of an RFC 3339 time with up to nine digits after the second.

    Raises:
        ValueError: the text is not such a time.
    """
    match = _PATTERN.fullmatch(text)
    if match is None:
        raise ValueError(f"must be a time such as 2026-01-01T00:00:00.123456789Z; got {text!r}")
    try:
        whole = datetime.fromisoformat(match["whole"] + match["zone"].replace("Z", "+00:00"))
    except ValueError as error:
        raise ValueError(f"must be a time; got {text!r}: {error}") from error
    # Not timestamp(): a float has no room for nanoseconds.
    since = whole - _EPOCH
    fraction = int((match["fraction"] or "").ljust(9, "0"))
    return (since.days * 86_400 + since.seconds) * _SECOND + fraction


def parse_seconds(text: str) -> float:
    """Seconds since the epoch of an RFC 3339 time. Raises ValueError if the text is not such a time."""
    return parse_time(text) / _SECOND


def format_seconds(seconds: float) -> str:
    """The time in UTC with milliseconds, as in statuses: ``2026-05-04T10:20:30.500Z``.

    Raises:
        ValueError: the time is outside the years 1 to 9999.
    """
    return f"{format_time(round(seconds * 1000) * 1_000_000)[:-7]}Z"


def format_microseconds(seconds: float) -> str:
    """The same with microseconds, as the API requires in Leases and Events."""
    return format_seconds(seconds).replace("Z", "000Z")
