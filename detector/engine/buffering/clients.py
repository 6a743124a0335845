"""The known clients: a client is known from its first sample until nothing was received from it for `clientTimeout`.

A client with a liveliness token is known as long as it has one, and lost at the first tick after its last one was
dropped. An expected client is known from the detector's start, even if it sends nothing.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

from detector.engine.buffering.buffer import NEVER, Buffer
from detector.engine.samples.liveliness import Tokens


@dataclass(slots=True)
class Presence:
    """When a client became known, and when something was last received from it; nanoseconds."""

    since: int
    last: int
    """A lower bound: the buffer may have newer samples."""
    timeout: int | None = None
    """How long the client stays known without a sample, in nanoseconds; None: the Detector's `clientTimeout`."""
    restored: bool = False
    """Whether the client is known only from a restored episode: nothing was received from it yet."""


class Clients:
    """The known clients and their labels."""

    def __init__(self, buffer: Buffer) -> None:
        """`buffer` has the samples of the clients. Call `configure` before use."""
        self._buffer = buffer
        self._labels: Mapping[str, Mapping[str, str]] = {}
        self._timeout = 0
        self._expected: frozenset[str] = frozenset()
        self._present: dict[str, Presence] = {}
        self._sorted: list[str] | None = None
        """The sorted names of the known clients; None after a client was added or removed."""
        self.tokens = Tokens()
        self.newest = NEVER
        """An upper bound of the time at which the newest client became known; nanoseconds."""
        self._next_timeout: int | None = NEVER
        """The earliest time at which a client can be lost by its timeout (nanoseconds); None: never in the current
        state."""

    def configure(
        self, labels: Mapping[str, Mapping[str, str]], timeout: int, expected: Collection[str], now: int
    ) -> None:
        """Apply a changed Detector: its labels, its timeout, and the clients that are expected from `now` on.

        The timeout of a client that is no longer expected counts from `now` at the earliest.
        """
        self._update_last()  # the buffer may drop streams
        self._labels, self._timeout = labels, timeout
        self._next_timeout = NEVER
        for client in self._expected.difference(expected):
            self.still_present(client, now)
        self._expected = frozenset(expected)
        for client in self._expected:
            if client not in self._present:
                self._present[client] = Presence(now, now)
                self._sorted = None
                self.newest = max(self.newest, now)

    def note_presence(self, client: str, time: int, timeout: int | None = None) -> None:
        """Called with the first sample of the client on a stream, or its liveliness token.

        `timeout` (ns) is given for a stream with items: a client of several streams gets the longest of all.
        """
        presence = self._present.get(client)
        if presence is None:
            self._present[client] = Presence(time, time, timeout)
            self._sorted = None
            self.newest = max(self.newest, time)
            deadline = time + (self._timeout if timeout is None else timeout)
            self._next_timeout = NEVER if self._next_timeout is None else min(self._next_timeout, deadline)
        elif presence.restored:
            presence.timeout, presence.restored = timeout, False
            self._next_timeout = NEVER
        elif presence.timeout is not None:
            presence.timeout = None if timeout is None else max(timeout, presence.timeout)
        self.still_present(client, time)

    def restore(self, client: str, time: int) -> None:
        """An episode about the client was restored: without samples, it stays known until `clientTimeout`."""
        known = client in self._present
        self.note_presence(client, time)
        self._present[client].restored = not known

    def still_present(self, client: str, time: int) -> None:
        """The client's newest sample has this time; an unknown client stays unknown."""
        presence = self._present.get(client)
        if presence is not None and time > presence.last:
            presence.last = time

    def may_remove(self, now: int) -> bool:
        """Whether `remove_lost` may find lost clients: a timeout expired, or a token was added or removed."""
        if not self.tokens.changed and self._next_timeout is not None and now > self._next_timeout:
            self._update_last()
        return self.tokens.changed or (self._next_timeout is not None and now > self._next_timeout)

    def _update_last(self) -> None:
        """Update when something was last received from each client, and the earliest time at which one can time out."""
        for name, presence in self._present.items():
            presence.last = max(presence.last, self._buffer.latest(name))
        deadlines = (
            presence.last + self._timeout_of(presence)
            for name, presence in self._present.items()
            if name not in self._expected and not self.tokens.has_token(name)
        )
        self._next_timeout = min(deadlines, default=None)

    def remove_lost(self, now: int) -> list[str]:
        """Remove the clients that have timed out without a token, or whose last token was dropped; returns them.

        Expected clients are never lost.
        """
        tokens = self.tokens
        self._update_last()
        lost = [
            name
            for name, presence in self._present.items()
            if (
                (now - presence.last > self._timeout_of(presence) and not tokens.has_token(name))
                or tokens.dropped(name)
            )
            and name not in self._expected
        ]
        tokens.forget_dropped()
        for name in lost:
            del self._present[name]
            self._sorted = None
        return lost

    def _timeout_of(self, presence: Presence) -> int:
        return self._timeout if presence.timeout is None else presence.timeout

    def gap(self, time: int) -> None:
        """Nothing could be received up to `time`: timeouts count from there at the earliest."""
        self.newest = min(self.newest, time)
        for presence in self._present.values():
            presence.since = min(presence.since, time)
            presence.last = time

    def missing(self, now: int) -> list[str]:
        """The expected clients that would be lost if they were not expected, by name; `now` in nanoseconds."""
        return [
            name
            for name in sorted(self._expected)
            if now - self.last(name) > self._timeout and not self.tokens.has_token(name)
        ]

    def knows(self, client: str, time: int) -> bool:
        """Whether the client has been known since this time or longer; nanoseconds."""
        presence = self._present.get(client)
        return presence is not None and presence.since <= time

    def since(self, client: str) -> int:
        """The time at which the client became known, in nanoseconds since the epoch."""
        return self._present[client].since

    def last(self, client: str) -> int:
        """When something was last received from the client, in nanoseconds since the epoch."""
        return max(self._present[client].last, self._buffer.latest(client))

    def labels(self, client: str) -> Mapping[str, str]:
        """The client's labels in the Detector."""
        return self._labels.get(client, {})

    def __len__(self) -> int:
        return len(self._present)

    def __contains__(self, client: str) -> bool:
        return client in self._present

    def __iter__(self) -> Iterator[str]:
        if self._sorted is None:
            self._sorted = sorted(self._present)
        return iter(self._sorted)


def fresh_streams(client: str, streams: Mapping[str, int | None], buffer: Buffer, now: int) -> list[str]:
    """The names of the client's streams that are not stale; `streams` has each one's staleAfter, None for never."""
    return [stream for stream, limit in streams.items() if is_fresh(client, stream, limit, buffer, now)]


def is_fresh(client: str, stream: str, limit: int | None, buffer: Buffer, now: int) -> bool:
    """Whether the newest sample is at most `limit` nanoseconds old (None: of any age)."""
    lane = buffer.lane(client, stream)
    return lane is not None and lane.latest != NEVER and (limit is None or now - lane.latest <= limit)
