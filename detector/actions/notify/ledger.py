"""The progress of each episode's messages, and the outcome that follows from it. Pure except for the reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from detector.actions.episode import Episode, Outcome, OutcomeState


@dataclass(slots=True)
class _Entry:
    episode: Episode | None = None
    """None: the episode is from before the restart."""
    open: bool = False
    waiting: int = 0
    delivered: int = 0
    attempts: int = 0
    bytes: int = 0
    failures: list[str] = field(default_factory=list)
    remark: str = ""


class DeliveryLedger:
    """Counts by episode. An episode is finished once none of its messages is queued and no more will follow."""

    def __init__(self, report: Callable[[Episode, Outcome], None]) -> None:
        self._report = report
        self._entries: dict[str, _Entry] = {}

    def open(self, episode: Episode) -> None:
        """Register the episode."""
        entry = self._entry(episode.id)
        entry.episode, entry.open = episode, True
        if episode.unrendered:
            entry.remark = "; ".join(f"{name}: {why}" for name, why in sorted(episode.unrendered.items()))

    def close(self, episode: str) -> None:
        """No further messages of the episode will follow."""
        if episode in self._entries:
            self._entries[episode].open = False
            self._settle(episode)

    def expect(self, episode: str) -> None:
        """A message of the episode was queued."""
        self._entry(episode).waiting += 1

    def delivered(self, episode: str, size: int) -> None:
        """A message of `size` bytes was delivered."""
        entry = self._entry(episode)
        entry.waiting -= 1
        entry.attempts += 1
        entry.delivered += 1
        entry.bytes += size
        if entry.open or entry.waiting:
            self._report_entry(entry, OutcomeState.RUNNING, f"{entry.delivered} delivered")
        self._settle(episode)

    def retried(self, episode: str, why: str) -> None:
        """A message was not delivered, and will be retried."""
        entry = self._entry(episode)
        entry.attempts += 1
        self._report_entry(entry, OutcomeState.RUNNING, f"not delivered yet: {why}")

    def kept(self, episode: str) -> None:
        """A message is left for the next start of the detector."""
        entry = self._entry(episode)
        self._report_entry(entry, OutcomeState.RUNNING, "not delivered yet: the detector retries after its next start")

    def failed(self, episode: str, why: str) -> None:
        """A message was given up."""
        entry = self._entry(episode)
        entry.waiting -= 1
        entry.attempts += 1
        entry.failures.append(why)
        if entry.open or entry.waiting:
            self._report_entry(entry, OutcomeState.RUNNING, f"not delivered: {why}")
        self._settle(episode)

    def _entry(self, episode: str) -> _Entry:
        return self._entries.setdefault(episode, _Entry())

    def _settle(self, episode: str) -> None:
        entry = self._entries[episode]
        if entry.open or entry.waiting > 0:
            return
        del self._entries[episode]
        if entry.failures:
            self._report_entry(entry, OutcomeState.FAILED, "not delivered: " + "; ".join(dict.fromkeys(entry.failures)))
        else:
            self._report_entry(entry, OutcomeState.DONE, "" if entry.delivered else "there was nothing to send")

    def _report_entry(self, entry: _Entry, state: OutcomeState, message: str) -> None:
        if entry.episode is None:
            return
        text = f"{message} ({entry.remark})" if message and entry.remark else message or entry.remark
        details = {"messages": entry.delivered, "attempts": entry.attempts}
        lost = len(entry.failures)
        self._report(entry.episode, Outcome(state, text, bytes=entry.bytes, missing=lost, details=details))
