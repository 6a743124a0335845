"""Messages are taken and handed over burst by burst: what a burst costs is shared by all that are in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

Put = Callable[[Sequence[tuple[str, bytes]]], None]
"""Takes messages that came together: the key and the payload of each. Thread-safe, and never waits."""

LONGEST = 256
"""At most so many messages are queued at once: taking that many takes a fraction of a millisecond."""
