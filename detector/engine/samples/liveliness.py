"""Liveliness tokens: a client declares a token while it is present, and the network reports when the token is gone.

Changes of tokens go through the intake like samples, on a separate stream name, so they are recorded and replayed in
order with the samples. The payload is the change of the token with that key.
"""

from __future__ import annotations

from enum import Enum

LIVELINESS = "~liveliness"
"""The stream name of token changes; no stream of a Detector can have this name."""

MAXIMUM_TOKENS = 200_000
"""Maximum number of known tokens; further ones are ignored and counted."""


class TokenState(Enum):
    """A change of a token: the payload of its arrival."""

    DECLARED = b"declared"
    DROPPED = b"dropped"
    """The client withdrew it, or its session ended: the client is lost."""
    UNSURE = b"unsure"
    """It is no longer visible because our own connection is gone: the client may still be there."""


class Tokens:
    """The known tokens and their clients."""

    def __init__(self) -> None:
        self._clients: dict[str, str] = {}
        """By key, the client of the token."""
        self._counts: dict[str, int] = {}
        self._dropped: set[str] = set()
        self.changed = False
        """Whether any token was added or removed since the last tick."""

    def declare(self, key: str, client: str) -> bool:
        """Add a token; False if there are too many."""
        self.changed = True
        if key not in self._clients:
            if len(self._clients) >= MAXIMUM_TOKENS:
                return False
            self._clients[key] = client
            self._counts[client] = self._counts.get(client, 0) + 1
        self._dropped.discard(client)
        return True

    def withdraw(self, key: str, *, lost: bool) -> str | None:
        """Remove a token; returns the client if this was its last token. `lost`: the client is lost by that."""
        self.changed = True
        client = self._clients.pop(key, None)
        if client is None:
            return None
        self._counts[client] -= 1
        if self._counts[client]:
            return None
        del self._counts[client]
        if lost:
            self._dropped.add(client)
        return client

    def has_token(self, client: str) -> bool:
        """Whether the client has a token."""
        return client in self._counts

    def dropped(self, client: str) -> bool:
        """Whether the client's last token was dropped since the last tick, without a new one."""
        return client in self._dropped

    def forget_dropped(self) -> None:
        """The tick has handled the dropped tokens."""
        self.changed = False
        self._dropped.clear()

    def forget(self) -> list[str]:
        """Forget all tokens, because the Detector watches others; returns their clients."""
        self.changed = True
        clients = list(self._counts)
        self._clients.clear()
        self._counts.clear()
        self._dropped.clear()
        return clients
