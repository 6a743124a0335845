"""Messages are received and passed on in bursts: all messages of a burst share its cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence

Put = Callable[[Sequence[tuple[str, bytes]]], None]
"""Receives messages that arrived together: the key and the payload of each. Thread-safe, and never waits."""

LONGEST = 256
"""Maximum number of messages that are queued at once: receiving them takes a fraction of a millisecond."""
