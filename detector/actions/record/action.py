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

from detector.actions.base import Action, ActionContext, ActionError, DetectorConfiguration
from detector.actions.episode import Completion, Episode, EpisodeSample, Outcome, OutcomeState
from detector.actions.record.description import Description
from detector.actions.record.destination import Destination, FinishedRecording, NoRoomError, destination
from detector.actions.record.folder import RecordingFolder
from detector.actions.record.recording import Recording, reason
from detector.actions.record.recovery import REASON, recover
from detector.actions.record.series import RecordedSeries
from wayside.api.actions import record as api

log = logging.getLogger(__name__)

_FLUSH_SECONDS = 0.5
"""Maximum seconds until a sample is passed to the kernel: the loss caused by a kill -9."""
_REPORT_SECONDS = 5.0
_EXPIRE_SECONDS = 30.0


@dataclass(slots=True)
class _Open:
    """An episode that is being recorded."""

    series: RecordedSeries
    episode: Episode
    reported: float


class Record(Action[api.RecordAction]):
    """Writes the samples of each episode into a rosbag2 folder with MCAP files."""

    Parameters: ClassVar[type[BaseModel]] = api.RecordAction

    def __init__(self, parameters: api.RecordAction, context: ActionContext) -> None:
        super().__init__(parameters, context)
        self._open: dict[str, _Open] = {}
        self._flushed = self._expired = -math.inf

    def started(self, episode: Episode) -> None:
        """Begins a recording. Raises ActionError if there is no room, unless another attempt follows later."""
        configuration = self.context.configuration()
        renew = self.parameters.renew_after
        start = None if episode.resumed else episode.onset_time - self.parameters.before.ns
        try:
            series = RecordedSeries(
                self._begin,
                self._description(episode, configuration),
                start=start,
                renew_after=None if renew is None else renew.ns,
            )
        except (NoRoomError, OSError) as error:
            raise ActionError(f"cannot start the recording: {reason(error)}") from error
        self._open[episode.id] = _Open(series, episode, time.monotonic())
        self.context.report(episode, Outcome(OutcomeState.RUNNING, series.problem))

    def samples(self, episode: Episode, samples: Sequence[EpisodeSample]) -> None:
        """Adds them to the recording. An error ends the recording, which is kept as cut."""
        current = self._open.get(episode.id)
        if current is None:  # its recording ended early, which was reported
            self._lose(len(samples))
            return
        current.series.add(samples, self.context.configuration())
        self._report_finished(current)

    def ended(self, episode: Episode) -> None:
        """Update the description; samples of `after` may follow."""
        self._update_episode(episode)

    def completed(self, episode: Episode, completion: Completion) -> None:
        """Completes the recording."""
        current = self._update_episode(episode)
        if current is None:
            self._lose(completion.missing)
            return
        current.series.finish(completion.cut, completion.missing)
        self._report_finished(current, over=True)

    def wake(self) -> float | None:
        """Flushes queued samples, reports the progress of recordings, and deletes those that are too old."""
        now = time.monotonic()
        if now - self._expired >= _EXPIRE_SECONDS:
            self._expired = now
            self._tidy()
        if now - self._flushed >= _FLUSH_SECONDS:
            self._flushed = now
            for current in [*self._open.values()]:
                self._flush(current, now)
        waiting = any(current.series.waiting for current in self._open.values())
        return _FLUSH_SECONDS if waiting else _REPORT_SECONDS if self._open else _EXPIRE_SECONDS

    def close(self) -> None:
        """Completes the open recordings, marked as cut."""
        for current in [*self._open.values()]:
            current.series.finish("the detector stopped", 0)
            self._report_finished(current, over=True)

    def _update_episode(self, episode: Episode) -> _Open | None:
        """Update the description of the recording with the current state of the episode; None if it has ended early."""
        current = self._open.get(episode.id)
        if current is not None:
            current.episode = episode
            current.series.description = replace(current.series.description, episode=episode)
        return current

    def _flush(self, current: _Open, now: float) -> None:
        current.series.flush()
        self._report_finished(current)
        if now - current.reported >= _REPORT_SECONDS and not current.series.over:
            current.reported = now
            self.context.report(current.episode, current.series.outcome(OutcomeState.RUNNING))

    def _report_finished(self, current: _Open, *, over: bool = False) -> None:
        """Reports the outcome if the recording is finished: done if it is complete, otherwise failed."""
        series, episode = current.series, current.episode
        lost, series.lost = series.lost, 0
        self._lose(lost)
        if not (over or series.over):
            return
        del self._open[episode.id]
        if series.problem:
            log.error("rule %s, episode %s: the recording ended early: %s", episode.rule, episode.id, series.problem)
        self.context.report(episode, series.outcome(OutcomeState.FAILED if series.problem else OutcomeState.DONE))

    def _lose(self, samples: int) -> None:
        if samples:
            self.context.lose("samples to record", samples, "the recording ended early")

    def _begin(self, description: Description, start: int | None) -> Recording:
        """A new recording. Raises NoRoomError, OSError."""
        configuration = self.context.configuration()
        folder = RecordingFolder.create(
            self._destination(configuration), description.rule, description.name, self._dropped
        )
        return Recording(folder, description.fields(), self.parameters, configuration, start=start)

    def _tidy(self) -> None:
        """Completes the recordings of earlier runs, on another thread, and deletes those that are too old."""
        try:
            place = self._destination(self.context.configuration())
            if left := place.take_unfinished():
                thread = threading.Thread(
                    target=self._recover, args=(place, left), name="recordings-recovery", daemon=True
                )
                thread.start()
            self._dropped(place.expire(), "older than spec.recordings.age")
        except (ActionError, OSError) as error:
            log.error("rule %s: cannot use the folder of recordings: %s", self.context.rule.name, error)

    def _recover(self, place: Destination, left: Sequence[Path]) -> None:
        try:
            kept = recover(place, left)
        except Exception as error:  # remains of a kill may be malformed, and must not prevent new recordings
            log.exception("cannot complete interrupted recordings")
            self.context.lose("times interrupted recordings could not be completed", 1, str(error))
            return
        if kept:
            self.context.lose("recordings cut short", len(kept), REASON)

    def _destination(self, configuration: DetectorConfiguration) -> Destination:
        recordings = configuration.detector.spec.recordings
        if recordings is None:
            raise ActionError(f"Detector {configuration.detector.name} has no spec.recordings: add it")
        return destination(recordings)

    def _dropped(self, dropped: Sequence[FinishedRecording], why: str = "deleted to make room for newer ones") -> None:
        for each in dropped:
            log.warning("%s: deleted the recording: %s", each.path, why)
        if dropped:
            self.context.lose("recordings", len(dropped), why)

    def _description(self, episode: Episode, configuration: DetectorConfiguration) -> Description:
        context = self.context
        return Description(
            holder=context.holder,
            detector=configuration.detector.name,
            rule=context.rule.name,
            generation=context.rule.metadata.generation,
            action=context.action,
            episode=episode,
            continued=episode.resumed,
            part=0 if self.parameters.renew_after is None else 1,
        )
