"""The errors of requests to the API server."""

from __future__ import annotations

_BAD_MANIFEST = "failed to create typed patch object"
_TRANSIENT = frozenset({401, 408, 409, 429})  # 401: the next request reads a renewed token


class RequestError(Exception):
    """A request to the API server failed.

    Attributes:
        reason: the API server's reason, one word.
        retry_after: the seconds to wait that the API server requests; None if it requests none.
        permanent: whether a retry cannot succeed.
    """

    reason = "Unknown"
    retry_after: float | None = None
    permanent = False


class Unreachable(RequestError):  # noqa: N818  a state, not a fault
    """The API server did not respond."""

    reason = "NoAnswer"


class NotActive(RequestError):  # noqa: N818  a state, not a fault
    """Another manager is active, or may be: nothing is written."""

    def __init__(self) -> None:
        super().__init__("this manager is not the active one and writes nothing")


class NotGranted(RequestError):  # noqa: N818  a state, not a fault
    """The account may not write in this namespace: nothing is written there, and a retry is useless."""

    def __init__(self, namespace: str) -> None:
        super().__init__(f"namespace {namespace} is not granted to this manager, which writes nothing there")


class ApiError(RequestError):
    """The API server refused the request.

    Attributes:
        code: the HTTP status.
        message: the API server's message.
        causes: the reasons of the causes, such as NamespaceTerminating.
    """

    def __init__(
        self,
        code: int,
        message: str,
        retry_after: float | None = None,
        causes: tuple[str, ...] = (),
        reason: str = "Unknown",
    ) -> None:
        super().__init__(f"{message} (HTTP {code})")
        self.code = code
        self.message = message
        self.retry_after = retry_after
        self.causes = causes
        self.reason = reason
        self.permanent = _BAD_MANIFEST in message if code >= 500 else code not in _TRANSIENT
        """A bad request, or a manifest of the wrong types (HTTP 500)."""

    @property
    def exists(self) -> bool:
        """Whether an object of the name already exists."""
        return self.code == 409 and self.reason == "AlreadyExists"

    @property
    def terminating(self) -> bool:
        """Whether the namespace is terminating or deleted."""
        gone = self.code == 404 and self.message.startswith("namespaces ")
        return gone or "NamespaceTerminating" in self.causes

    @property
    def replaced(self) -> bool:
        """Whether the object has another uid than the request requires: another object has replaced it."""
        return self.code == 409 and "UID in precondition" in self.message
