"""RFC 3339 times in statuses, as seconds since 1970 (UTC)."""

from __future__ import annotations

from datetime import UTC, datetime


def parse_time(text: str) -> float:
    """Seconds since 1970. Raises ValueError for what is no RFC 3339 time."""
    return datetime.fromisoformat(_microseconds(text)).timestamp()


def format_time(seconds: float) -> str:
    """RFC 3339 with milliseconds, e.g. 2026-05-04T10:20:30.500Z."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _microseconds(text: str) -> str:
    """Nanoseconds are more than datetime takes."""
    head, point, rest = text.partition(".")
    if not point:
        return text
    digits = len(rest) - len(rest.lstrip("0123456789"))
    return f"{head}.{rest[: min(digits, 6)]}{rest[digits:]}"
