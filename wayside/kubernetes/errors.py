"""What a request to the API server may raise."""

from __future__ import annotations

_BAD_MANIFEST = "failed to create typed patch object"


class Unreachable(Exception):  # noqa: N818  a state of the world
    """The API server gave no answer."""


class NotActive(Unreachable):
    """Another manager is active, or may be: nothing is written."""

    def __init__(self) -> None:
        super().__init__("this manager is not the active one and writes nothing")


class NotGranted(Unreachable):
    """The account may not write in this namespace: nothing is written there, and nothing needs to be tried again."""

    def __init__(self, namespace: str) -> None:
        super().__init__(f"namespace {namespace} is not granted to this manager, which writes nothing there")


class ApiError(Exception):
    """The API server refused.

    Attributes:
        code: the HTTP status.
        message: the API server's message.
        retry_after: seconds to wait that it requests; None where it requests none.
        causes: the reasons of the causes, such as NamespaceTerminating.
    """

    def __init__(self, code: int, message: str, retry_after: float | None = None, causes: tuple[str, ...] = ()) -> None:
        super().__init__(f"{message} (HTTP {code})")
        self.code = code
        self.message = message
        self.retry_after = retry_after
        self.causes = causes

    @property
    def permanent(self) -> bool:
        """Whether repeating the request is in vain: a bad request, or a manifest of the wrong types (HTTP 500)."""
        if self.code >= 500:
            return _BAD_MANIFEST in self.message
        return self.code not in (401, 408, 409, 429)

    @property
    def terminating(self) -> bool:
        """Whether the namespace is going or gone."""
        gone = self.code == 404 and self.message.startswith("namespaces ")
        return gone or "NamespaceTerminating" in self.causes

    @property
    def replaced(self) -> bool:
        """Whether the object has another uid than the request requires: it was replaced by a namesake."""
        return self.code == 409 and "UID in precondition" in self.message
