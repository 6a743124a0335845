"""Errors of the API server, classified by what the caller should do."""

from __future__ import annotations

import json

from wayside.inputerror import InputError


class ApiError(Exception):
    """A request to the API server failed. The message is the server's, or the reason why there was no response."""

    def __init__(self, code: int, reason: str, message: str) -> None:
        super().__init__(f"{code} {reason}: {message}" if code else f"{reason}: {message}")
        self.code = code
        """The HTTP status; 0 without a response."""
        self.reason = reason
        """The API's reason, e.g. `Forbidden`."""
        self.message = message


class UnavailableError(ApiError):
    """No response, or one that requests a retry: the same request may succeed soon."""

    def __init__(self, code: int, reason: str, message: str, retry_after: float = 0.0) -> None:
        super().__init__(code, reason, message)
        self.retry_after = retry_after
        """Seconds to wait as requested by the server; 0 if not given."""


class RefusedError(ApiError):
    """The server rejected the request: retrying it unchanged is useless."""


class NotFoundError(RefusedError):
    """The object, namespace or kind does not exist."""


class AlreadyExistsError(RefusedError):
    """An object of this name exists."""


class ConflictError(RefusedError):
    """The object or its state is not what the request expected: read it again."""


class GoneError(RefusedError):
    """The resource version is too old to continue a watch: list again."""


_UNAVAILABLE_CODES = frozenset({401, 408, 429})
"""In addition to 5xx. 401 because a token that has just been rotated is read again with the next request."""


def error_of(code: int, body: bytes, retry_after: str | None = None) -> ApiError:
    """The error for a response.

    Args:
        code: the HTTP status, 400 or more (or the code of a watch's ERROR event).
        body: the answer, usually a Status object.
        retry_after: the header, in seconds.
    """
    reason, message = "Unknown", body[:500].decode(errors="replace").strip()
    try:
        status = json.loads(body)
        reason, message = str(status.get("reason", reason)), str(status.get("message", message))
    except (ValueError, AttributeError):
        pass  # a proxy's page instead of a Status: its beginning is the message
    if code in _UNAVAILABLE_CODES or code >= 500:
        wait = float(retry_after) if retry_after and retry_after.isdigit() else 0.0
        return UnavailableError(code, reason, message, wait)
    if code == 409:
        return (AlreadyExistsError if reason == "AlreadyExists" else ConflictError)(code, reason, message)
    kind = {404: NotFoundError, 410: GoneError}.get(code, RefusedError)
    return kind(code, reason, message)


class NoClusterError(InputError):
    """There is no access to an API server; the message gives the remedy."""
