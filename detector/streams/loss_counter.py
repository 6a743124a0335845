"""Problems before the intake, counted by cause and by stream or source. The counts survive sessions and sources."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from enum import StrEnum


class Cause(StrEnum):
    """Why something did not reach the intake. The texts are used in the log."""

    MISSED = "samples of stream {} lost before the detector, by the sequence numbers of their publishers"
    OVERTAKEN = "samples of stream {} arrived after later ones, and were counted as lost"
    MISFIT = "samples of stream {} dropped because their keys do not match the stream"
    UNNUMBERED = "samples of stream {} received without a sequence number, so that losses are not counted"
    UNROUTED = "messages of source {} dropped because no stream matches their keys"
    FAILED = "times source {} failed and was restarted"
    LEFT_BEHIND = "times source {} did not stop and was abandoned"


@dataclass(frozen=True, slots=True)
class LossCount:
    """How often something happened."""

    cause: Cause
    name: str
    """The stream, or the source."""
    count: int
    last: str
    """The reason of the last one, if known."""

    @property
    def text(self) -> str:
        """The cause in words."""
        return self.cause.value.format(self.name)


class LossCounter:
    """Counters, thread-safe. There is an entry for each cause and each stream or source, so their number is bounded."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: dict[tuple[Cause, str], tuple[int, str]] = {}

    def add(self, cause: Cause, name: str, count: int = 1, last: str = "") -> None:
        """Count it `count` times for the stream or source of that name."""
        with self._lock:
            before, _ = self._counts.get((cause, name), (0, ""))
            self._counts[cause, name] = before + count, last

    def entries(self) -> list[LossCount]:
        """All entries, in order of cause and name."""
        with self._lock:
            return [LossCount(*key, *value) for key, value in sorted(self._counts.items())]
