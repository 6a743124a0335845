"""The record action: one recording for each episode of its rule, all in the Detector's folder for recordings."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from pydantic import BaseModel

from detector.actions.base import Action, ActionError, Setting, Surroundings
from detector.actions.episode import Completion, Episode, EpisodeSample, Outcome, OutcomeState
from detector.actions.record.description import Description
from detector.actions.record.destination import Destination, Kept, NoRoomError, destination
from detector.actions.record.folder import Folder
from detector.actions.record.recording import Recording, reason
from detector.actions.record.recovery import REASON, recover
from wayside.api.actions import record as api

log = logging.getLogger(__name__)

_FLUSH_SECONDS = 0.5
"""What a sample waits at most before the kernel has it: about what a kill -9 costs."""
_REPORT_SECONDS = 5.0
_EXPIRE_SECONDS = 30.0


@dataclass(slots=True)
class _Open:
    """An episode that is being recorded."""

    recording: Recording
    episode: Episode
    description: Description
    reported: float


class Record(Action[api.Record]):
    """Writes the samples of each episode into a rosbag2 folder with MCAP files."""

    Parameters: ClassVar[type[BaseModel]] = api.Record

    def __init__(self, parameters: api.Record, setting: Setting) -> None:
        super().__init__(parameters, setting)
        self._open: dict[str, _Open] = {}
        self._flushed = self._expired = -math.inf

    def started(self, episode: Episode) -> None:
        """Begins a recording. Raises ActionError where there is no room for one."""
        surroundings = self.setting.surroundings()
        description = self._description(episode, surroundings)
        before = self.parameters.before.ns
        try:
            folder = Folder.create(self._destination(surroundings), description.rule, description.name, self._dropped)
            recording = Recording(
                folder,
                description.told(),
                self.parameters,
                surroundings,
                start=None if episode.resumed else episode.onset_time - before,
            )
        except (NoRoomError, OSError) as error:
            raise ActionError(f"the recording cannot begin: {reason(error)}") from error
        self._open[episode.id] = _Open(recording, episode, description, time.monotonic())
        self.setting.report(episode, Outcome(OutcomeState.RUNNING))

    def samples(self, episode: Episode, samples: Sequence[EpisodeSample]) -> None:
        """Adds them to the recording. What goes wrong ends it, and it is kept as cut."""
        current = self._open.get(episode.id)
        if current is None:  # its recording ended early: that is reported
            self.setting.lose("samples to record", len(samples), "their recording ended early")
            return
        try:
            current.recording.take(samples, self.setting.surroundings())
        except (NoRoomError, OSError) as error:
            self._finish(current, cut=reason(error))

    def ended(self, episode: Episode) -> None:
        """Samples of `after` may follow."""
        if current := self._open.get(episode.id):
            current.episode = episode

    def completed(self, episode: Episode, completion: Completion) -> None:
        """Completes the recording."""
        if current := self._open.get(episode.id):
            current.episode = episode
            self._finish(current, cut=completion.cut, missing=completion.missing)
        elif completion.missing:
            self.setting.lose("samples to record", completion.missing, "their recording ended early")

    def wake(self) -> float | None:
        """Flushes what waits, says how far recordings are, and deletes those that are too old."""
        now = time.monotonic()
        if now - self._expired >= _EXPIRE_SECONDS:
            self._expired = now
            self._tidy()
        if now - self._flushed >= _FLUSH_SECONDS:
            self._flushed = now
            for current in [*self._open.values()]:
                self._flush(current, now)
        waiting = any(current.recording.waiting for current in self._open.values())
        return _FLUSH_SECONDS if waiting else _REPORT_SECONDS if self._open else _EXPIRE_SECONDS

    def close(self) -> None:
        """Completes what is still open, marked as cut."""
        for current in [*self._open.values()]:
            self._finish(current, cut="the detector ended")

    def _flush(self, current: _Open, now: float) -> None:
        try:
            current.recording.flush()
        except (NoRoomError, OSError) as error:
            self._finish(current, cut=reason(error))
            return
        if now - current.reported >= _REPORT_SECONDS:
            current.reported = now
            recording = current.recording
            outcome = Outcome(OutcomeState.RUNNING, samples=recording.written, bytes=recording.bytes)
            self.setting.report(current.episode, outcome)

    def _finish(self, current: _Open, cut: str = "", missing: int = 0) -> None:
        """Completes a recording and reports what became of it: done is what is whole, anything else has failed."""
        episode, recording = current.episode, current.recording
        del self._open[episode.id]
        told = replace(current.description, episode=episode).told()
        try:
            kept, told = recording.finish(told, cut, missing)
        except OSError as error:
            text = f"the recording cannot be completed, the next start tries again: {error}"
            self.setting.report(episode, Outcome(OutcomeState.FAILED, text, missing=recording.given + missing))
            log.error("rule %s, episode %s: %s", episode.rule, episode.id, text)
            return
        why = str(told.get("cut", ""))
        if why:
            log.error("rule %s, episode %s: the recording is cut: %s", episode.rule, episode.id, why)
        self.setting.report(
            episode,
            Outcome(
                OutcomeState.FAILED if why else OutcomeState.DONE,
                why,
                samples=recording.written if kept else 0,
                bytes=kept.bytes if kept else 0,
                missing=int(told.get("missing", 0)),
                files=tuple(f"{episode.rule}/{kept.path.name}/{name}" for name in told["files"]) if kept else (),
                details={"folder": str(kept.path)} if kept else {},
            ),
        )

    def _tidy(self) -> None:
        """What earlier runs left behind is completed, beside this thread; what is too old is deleted."""
        try:
            place = self._destination(self.setting.surroundings())
            if left := place.take_left():
                thread = threading.Thread(
                    target=self._recover, args=(place, left), name="recordings-recovery", daemon=True
                )
                thread.start()
            self._dropped(place.expire(), "older than spec.recordings.age")
        except (ActionError, OSError) as error:
            log.error("rule %s: the folder of recordings cannot be used: %s", self.setting.rule.name, error)

    def _recover(self, place: Destination, left: Sequence[Path]) -> None:
        try:
            kept = recover(place, left)
        except Exception:
            log.exception("recordings that were left behind cannot be completed")
            return
        if kept:
            self.setting.lose("recordings cut short", len(kept), REASON)

    def _destination(self, surroundings: Surroundings) -> Destination:
        recordings = surroundings.detector.spec.recordings
        if recordings is None:
            raise ActionError(f"Detector {surroundings.detector.name} does not say where: give its spec.recordings")
        return destination(recordings)

    def _dropped(self, dropped: Sequence[Kept], why: str = "dropped to make room for newer ones") -> None:
        for each in dropped:
            log.warning("%s: the recording was deleted: %s", each.path, why)
        if dropped:
            self.setting.lose("recordings", len(dropped), why)

    def _description(self, episode: Episode, surroundings: Surroundings) -> Description:
        setting = self.setting
        return Description(
            holder=setting.holder,
            detector=surroundings.detector.name,
            rule=setting.rule.name,
            generation=setting.rule.metadata.generation,
            action=setting.action,
            episode=episode,
            continued=episode.resumed,
        )
