"""Clips: the recordings that the record actions of rules make from a replay, as they would have live.

Only `record` actions run. Other actions reach databases, systems and people, which a replay must not affect.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from detector.actions.base import ActionError, DetectorConfiguration
from detector.actions.host import ActionHost
from detector.actions.record.destination import finished_recordings
from detector.engine.consequences import Consequence
from wayside.api import Detector, EventRule
from wayside.api.recordings import Recordings

RECORD = "record"
_GRACE = 3600.0
"""Seconds: a slow disk has time to complete the clips."""


class Clips:
    """The folder of all clips of one replay. Its limits are those of the Detector's `recordings`."""

    def __init__(self, folder: Path) -> None:
        """Raises OSError if clips of an earlier replay cannot be removed."""
        self.folder = folder
        for each in [*finished_recordings(folder)]:
            shutil.rmtree(each.path)

    def placed(self, detector: Detector) -> Detector:
        """The Detector with this folder for its recordings; it may have none."""
        path = str(self.folder)
        limits = detector.spec.recordings
        recordings = (limits or Recordings(path=path)).model_copy(update={"path": path, "age": None})
        return detector.model_copy(update={"spec": detector.spec.model_copy(update={"recordings": recordings})})

    def recorders(self, holder: str) -> Recorders:
        """The actions of one replay."""
        return Recorders(holder)

    @property
    def count(self) -> int:
        """Number of clips."""
        return sum(1 for _ in finished_recordings(self.folder))


class Recorders:
    """The record actions of the rules of one replay. The replay waits for them, so they are never too slow."""

    def __init__(self, holder: str) -> None:
        self._host = ActionHost(holder, _NoMessenger(), patient=True)

    def follow(self, rules: Sequence[EventRule], configuration: DetectorConfiguration) -> None:
        """Use these rules from now on."""
        self._host.follow([_recording(rule) for rule in rules], configuration)

    def dispatch(self, consequences: Sequence[Consequence]) -> None:
        """Pass on what happened, in order."""
        self._host.dispatch(consequences)

    def close(self) -> Iterator[str]:
        """Complete all clips. Returns a line for each action that failed or lost something."""
        self._host.close(_GRACE)
        for which, counts in self._host.outcomes.counts_by_action().items():
            if counts.failed:
                of = f"{counts.failed} of {counts.done + counts.failed} clips"
                yield f"{of} of action {which.action}, EventRule {which.rule}, are not whole: {counts.last_failure}"
        for lost in self._host.outcomes.lost():
            where = f"action {lost.which.action}, EventRule {lost.which.rule}"
            yield f"{lost.count} {lost.what} ({where}): {lost.last}"


class _NoMessenger:
    """Discards the progress events of a replay."""

    def publish(self, key: str, payload: bytes, encoding: str) -> None:
        """See `Messenger`."""

    def query(
        self, selector: str, payload: bytes | None, timeout: float, attachment: bytes | None = None
    ) -> list[bytes]:
        """See `Messenger`."""
        raise ActionError("a replay has no Zenoh session")


def _recording(rule: EventRule) -> EventRule:
    """The rule with only its record actions."""
    actions = [action for action in rule.spec.actions if action.field == RECORD]
    return rule.model_copy(update={"spec": rule.spec.model_copy(update={"actions": actions})})
