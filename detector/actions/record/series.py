"""The recordings of one episode: one, or several in sequence with `renewAfter`.

If a recording ends early, the episode has none any more; with `renewAfter` another one is attempted soon.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from detector.actions.base import DetectorConfiguration
from detector.actions.episode import EpisodeSample, Outcome, OutcomeState
from detector.actions.record.description import Description, with_ending
from detector.actions.record.destination import FinishedRecording, NoRoomError
from detector.actions.record.recording import Recording, reason

_AGAIN = 10 * 10**9
"""Nanoseconds after which another recording is attempted when one ended early."""

Begin = Callable[[Description, int | None], Recording]
"""Begins a recording whose window starts at the given time, if known. Raises NoRoomError, OSError."""


class RecordedSeries:
    """Receives the samples of an episode, and tracks their outcome."""

    def __init__(self, begin: Begin, description: Description, *, start: int | None, renew_after: int | None) -> None:
        """`start` of the window; `renew_after` in nanoseconds. Raises NoRoomError, OSError without `renew_after`."""
        self.description = description
        self._begin = begin
        self._renew_after = renew_after
        self._latched: list[EpisodeSample] = []
        self._again = 0
        self._recording: Recording | None = None
        self._kept: FinishedRecording | None = None
        self._files: list[str] = []
        self._count = self._samples = self._bytes = self._missing = 0
        self.problem = ""
        """Why part of the window is missing; the first reason."""
        self.lost = 0
        """Samples without a recording since the last read."""
        try:
            self._recording = begin(description, start)
        except (NoRoomError, OSError) as error:
            if renew_after is None:
                raise
            self.problem = reason(error)

    @property
    def over(self) -> bool:
        """Whether no recording is running or will follow."""
        return self._recording is None and self._renew_after is None

    @property
    def waiting(self) -> bool:
        """Whether there are samples to flush."""
        return self._recording is not None and self._recording.waiting

    def add(self, samples: Sequence[EpisodeSample], configuration: DetectorConfiguration) -> None:
        """Add samples."""
        while samples:
            recording = self._recording
            if recording is None:
                self._try_again(samples, configuration)
                recording = self._recording
                if recording is None:
                    self.lost += len(samples)
                    return
            now, rest = self._parted(recording, samples)
            samples = rest
            try:
                recording.add(now, configuration)
            except (NoRoomError, OSError) as error:
                self._again = max(sample.time for sample in now) + _AGAIN
                self._end(recording, reason(error), 0)
                continue
            if rest:
                self._end(recording, "", 0, continues=True)
                self._next(configuration)

    def flush(self) -> None:
        """Passes queued samples to the kernel."""
        if self._recording is not None:
            try:
                self._recording.flush()
            except (NoRoomError, OSError) as error:
                self._end(self._recording, reason(error), 0)

    def finish(self, cut: str, missing: int) -> None:
        """No more samples follow: see `Recording.finish`."""
        if self._recording is not None:
            self._end(self._recording, cut, missing)
        else:
            self.lost += missing

    def outcome(self, state: OutcomeState) -> Outcome:
        """The outcome until now; the files are those of the last recording."""
        open_one = self._recording
        return Outcome(
            state,
            self.problem,
            samples=self._samples + (0 if open_one is None else open_one.written),
            bytes=self._bytes + (0 if open_one is None else open_one.bytes),
            missing=self._missing,
            files=tuple(self._files),
            details={} if self._kept is None else {"folder": str(self._kept.path), "recordings": self._count},
        )

    def _parted(
        self, recording: Recording, samples: Sequence[EpisodeSample]
    ) -> tuple[Sequence[EpisodeSample], Sequence[EpisodeSample]]:
        """The samples of the current recording, and those of later ones."""
        began = recording.began_with(samples)
        if self._renew_after is None or began is None:
            return samples, ()
        seam = began + self._renew_after
        now = [sample for sample in samples if sample.time < seam]
        return (now, ()) if len(now) == len(samples) else (now, [each for each in samples if each.time >= seam])

    def _try_again(self, samples: Sequence[EpisodeSample], configuration: DetectorConfiguration) -> None:
        newest = max(sample.time for sample in samples)
        if self._renew_after is not None and newest >= self._again:
            self._again = newest + _AGAIN
            self._next(configuration)

    def _next(self, configuration: DetectorConfiguration) -> None:
        """Begins the next recording, with the last samples of latched streams."""
        description = self.description
        self.description = replace(description, part=description.part + 1, continued=True)
        try:
            self._recording = self._begin(self.description, None)
            self._recording.add(self._latched, configuration)
        except (NoRoomError, OSError) as error:
            self.problem = self.problem or reason(error)
            if self._recording is not None:
                self._end(self._recording, reason(error), 0)

    def _end(self, recording: Recording, cut: str, missing: int, *, continues: bool = False) -> None:
        self._recording = None
        self._latched = recording.latched
        try:
            kept, fields = recording.finish(
                with_ending(self.description.fields(), continues=continues or None), cut, missing
            )
        except OSError as error:
            self.problem = self.problem or f"cannot complete the recording; the next start retries: {error}"
            self._missing += recording.given + missing
            return
        self.problem = self.problem or str(fields.get("cut", ""))
        self._missing += int(fields.get("missing", 0))
        if kept is not None:
            self._kept = kept
            self._count += 1
            self._files = [f"{kept.path.parent.name}/{kept.path.name}/{name}" for name in fields["files"]]
            self._samples += recording.written
            self._bytes += kept.bytes
