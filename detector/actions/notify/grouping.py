"""Groups events into one message: they wait for each other, for a bounded time and in a bounded number. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from detector.actions.notify.notice import Notice

MOST = 10_000
"""Maximum number of events in all groups together; beyond it, the oldest group is closed early."""


@dataclass(slots=True)
class _Group:
    due: float
    notices: list[Notice] = field(default_factory=list)


class Groups:
    """Open groups, by the values of the grouping labels. Times are seconds of any one clock."""

    def __init__(self, by: Sequence[str], wait: float, most: int = MOST) -> None:
        self._by, self._wait, self._most = tuple(by), wait, most
        self._open: dict[tuple[str, ...], _Group] = {}
        self._count = 0

    def add(self, notice: Notice, now: float) -> None:
        """Add it to its group, which is opened if necessary."""
        key = tuple(notice.texts.labels.get(name, "") for name in self._by)
        if key not in self._open:
            self._open[key] = _Group(now + self._wait)
        self._open[key].notices.append(notice)
        self._count += 1

    def closed(self, now: float, everything: bool = False) -> list[list[Notice]]:
        """Remove and return the groups that are due, in the order in which they were opened."""
        found: list[list[Notice]] = []
        for key, group in list(self._open.items()):
            if everything or group.due <= now or self._count > self._most:
                del self._open[key]
                self._count -= len(group.notices)
                found.append(group.notices)
        return found

    def next_due(self) -> float | None:
        """When the next group is due; None: there is none."""
        return min((group.due for group in self._open.values()), default=None)
