"""When there is a tick apart from those for samples: at the rules' periods, and when a single subject must wake."""

from __future__ import annotations

import heapq
from collections.abc import Collection

from detector.engine.buffering.buffer import HOUSEKEEPING


class Ticks:
    """Times of ticks apart from samples: whole multiples of the rules' periods, and the wakes of subjects."""

    def __init__(self) -> None:
        self._periods: tuple[int, ...] = (HOUSEKEEPING,)
        self._wakes: list[int] = []
        """A heap; past entries are dropped when they are met."""
        self.triggers: frozenset[str] = frozenset()
        """The streams whose samples are evaluated at their own times."""

    def set_periods(self, periods: Collection[int]) -> None:
        """The rules' periods, in nanoseconds."""
        self._periods = tuple(sorted({HOUSEKEEPING, *periods}))

    def set_triggers(self, streams: Collection[str]) -> None:
        """The streams whose samples are evaluated at their own times."""
        self.triggers = frozenset(streams)

    def wake_at(self, time: int) -> None:
        """Schedule a tick at this time, if it is still in the future."""
        heapq.heappush(self._wakes, time)

    def after(self, time: int) -> int:
        """The first tick after a time."""
        regular = min(time - time % period + period for period in self._periods)
        while self._wakes and self._wakes[0] <= time:
            heapq.heappop(self._wakes)
        return min(regular, self._wakes[0]) if self._wakes else regular

    def is_regular(self, time: int) -> bool:
        """Whether the tick belongs to a period, not only to a sample or a wake."""
        return any(time % period == 0 for period in self._periods)
