"""When a refused apply is retried: with backoff, and at once when the objects change."""

from __future__ import annotations

from dataclasses import dataclass

from application_manager.core.objects.policy import Name
from wayside.process.backoff import pause_after

FIRST_PAUSE = 1.0  # s, doubled with every refusal of the same
LONGEST_PAUSE = 30.0  # s


@dataclass(frozen=True, slots=True)
class _Refused:
    what: object
    times: int
    until: float


class Attempts:
    """What was refused last, by instance."""

    def __init__(self) -> None:
        self._refused: dict[Name, _Refused] = {}

    def waits_until(self, name: Name, what: object, now: float) -> float | None:
        """Until when the same is not tried again, in seconds since 1970; None: it may be tried."""
        known = self._refused.get(name)
        return known.until if known is not None and known.what == what and now < known.until else None

    def refused(self, name: Name, what: object, now: float) -> float:
        """Note that it was refused; when it is to be tried again, in seconds since 1970."""
        known = self._refused.get(name)
        times = known.times + 1 if known is not None and known.what == what else 1
        until = now + pause_after(times, FIRST_PAUSE, LONGEST_PAUSE)
        self._refused[name] = _Refused(what, times, until)
        return until

    def forget(self, name: Name) -> None:
        """Note that nothing is refused, or that the instance is gone."""
        self._refused.pop(name, None)
