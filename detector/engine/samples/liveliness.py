"""Liveliness tokens: a client declares a token while it is there, and the network reports when the token is gone.

What happens to tokens comes through the intake like samples, on a stream name of its own, so it is recorded and
replayed in order with them. The payload is what happened to the token of that key.
"""

from __future__ import annotations

from enum import Enum

LIVELINESS = "~liveliness"
"""The stream name of what happens to tokens; no Detector's stream can be called so."""

MAXIMUM_TOKENS = 200_000
"""Maximum number of known tokens; further ones are ignored and counted."""


class Token(Enum):
    """What happened to a token: the payload of its arrival."""

    DECLARED = b"declared"
    DROPPED = b"dropped"
    """The client withdrew it, or its session ended: the client is lost."""
    UNSURE = b"unsure"
    """We cannot see it any more, since our own connection is gone: the client may be there still."""


class Tokens:
    """Which tokens there are, and whose they are."""

    def __init__(self) -> None:
        self._clients: dict[str, str] = {}
        """By key, whose token it is."""
        self._counts: dict[str, int] = {}
        self._dropped: set[str] = set()
        self.changed = False
        """Whether any token came or went since the last tick."""

    def declare(self, key: str, client: str) -> bool:
        """A token is there; False where there are too many."""
        self.changed = True
        if key not in self._clients:
            if len(self._clients) >= MAXIMUM_TOKENS:
                return False
            self._clients[key] = client
            self._counts[client] = self._counts.get(client, 0) + 1
        self._dropped.discard(client)
        return True

    def withdraw(self, key: str, *, lost: bool) -> str | None:
        """A token is gone; returns the client that has none left now, if there is one. `lost`: it is lost by that."""
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

    def hold(self, client: str) -> bool:
        """Whether the client has a token."""
        return client in self._counts

    def dropped(self, client: str) -> bool:
        """Whether the client's last token was dropped since the last tick, and no new one came."""
        return client in self._dropped

    def forget_dropped(self) -> None:
        """The tick took note."""
        self.changed = False
        self._dropped.clear()

    def forget(self) -> list[str]:
        """Forget all tokens, since the Detector watches others; returns whose they were."""
        self.changed = True
        clients = list(self._counts)
        self._clients.clear()
        self._counts.clear()
        self._dropped.clear()
        return clients
