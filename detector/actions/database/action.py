"""The database action: it turns episodes into requests, and reports their results."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bson

from detector.actions.base import Action, ActionContext, ActionError
from detector.actions.database import scenario as scenarios
from detector.actions.database.attachments import AttachmentFolder, FolderError
from detector.actions.database.documents import ConvertedDocument, Documents, bson_bytes
from detector.actions.database.queue import BATCH_BYTES, BATCH_DOCUMENTS, Write
from detector.actions.database.scenario import Scenario
from detector.actions.database.writer import DatabaseWriter, acquire, release
from detector.actions.episode import Completion, Episode, EpisodeSample, Outcome, OutcomeState
from wayside.api.actions.database import Attachments, DatabaseAction
from wayside.api.base import JsonValue
from wayside.api.database import DatabaseConnection as Place

_log = logging.getLogger(__name__)

FLUSH = 0.2
"""Maximum time in seconds that a document waits for others, to be sent in one batch."""


@dataclass(slots=True)
class _Batch:
    """Documents of one collection that are to be sent together."""

    documents: list[bytes] = field(default_factory=list)
    owners: Counter[str] = field(default_factory=Counter)
    bytes: int = 0


@dataclass(slots=True)
class ScenarioProgress:
    """An episode's current scenario, and the totals of the previous ones."""

    episode: Episode
    scenario: Scenario
    documents: Documents
    latched: frozenset[str]
    """The streams whose last samples each scenario receives."""
    renew_after: int | None
    """Nanoseconds."""
    seam: int | None = None
    """Samples from this time on belong to the next scenario; None while this is unknown."""
    latest: dict[tuple[str, str, str], EpisodeSample] = field(default_factory=dict)
    """The newest samples of latched streams."""
    trouble: str = ""
    """Why a previous scenario is incomplete; the first reason."""
    undecoded: int = 0
    scenarios: int = 1
    messages: Counter[str] = field(default_factory=Counter)
    """Of the previous scenarios, like bytes, files and lost."""
    bytes: int = 0
    files: int = 0
    lost: int = 0

    def parted(self, samples: Sequence[EpisodeSample]) -> tuple[Sequence[EpisodeSample], Sequence[EpisodeSample]]:
        """The samples of the current scenario, and those of later ones."""
        if self.renew_after is None:
            return samples, ()
        own = [sample.time for sample in samples if sample.stream not in self.latched]
        if self.seam is None and own:
            self.seam = min(own) + self.renew_after
        seam = self.seam
        now = [sample for sample in samples if seam is None or sample.time < seam]
        rest = [sample for sample in samples if seam is not None and sample.time >= seam]
        for sample in now:
            if sample.stream in self.latched:
                self.latest[sample.client, sample.stream, sample.key] = sample
        return now, rest

    def continue_in(self, scenario: Scenario, documents: Documents) -> None:
        """The current scenario has all its samples: switch to the next one."""
        self.messages += self.scenario.messages
        self.bytes += self.scenario.bytes
        self.files += self.scenario.files
        self.lost += sum(self.scenario.lost.values())
        self.scenarios += 1
        self.scenario, self.documents, self.seam = scenario, documents, None


class Database(Action[DatabaseAction]):
    """Writes each episode as a scenario."""

    Parameters = DatabaseAction

    def __init__(self, parameters: DatabaseAction, context: ActionContext) -> None:
        super().__init__(parameters, context)
        self._place: Place | None = None
        self._writer: DatabaseWriter | None = None
        self._folder: AttachmentFolder | None = None
        self._progress: dict[str, ScenarioProgress] = {}
        self._batches: dict[str, _Batch] = {}
        self._due = 0.0
        self._awake = False
        self._reported_away = False

    def started(self, episode: Episode) -> None:
        """Insert the scenario into the database, marked as incomplete."""
        self._connect()
        renew = self.parameters.renew_after
        # The documents of an earlier run may be complete: with renewAfter this scenario gets a different name.
        part = f"resumed-{time.time_ns()}" if episode.resumed and renew else ""
        scenario, documents = self._open(episode, part, resumed=episode.resumed)
        if why := episode.unrendered.get("metadata"):
            scenario.lost[f"metadata: {why}"] += 1
        streams = self.context.configuration().detector.spec.streams
        latched = frozenset(stream.name for stream in streams if stream.latched)
        self._progress[episode.id] = ScenarioProgress(
            episode, scenario, documents, latched, renew.ns if renew else None
        )
        self._report(episode, OutcomeState.RUNNING)

    def _open(self, episode: Episode, part: str, *, resumed: bool) -> tuple[Scenario, Documents]:
        rule, database = self.context.rule, self.parameters.database
        name = scenarios.scenario_id(episode, self.context.action, part)
        scenario = Scenario(name, self.context.holder, self.context.action, database, rule, resumed)
        configuration = self.context.configuration()
        above = None
        if configuration.detector.spec.database is not None and configuration.detector.spec.database.files is not None:
            above = (self.parameters.files or Attachments()).above.bytes
        streams = {stream.name: stream for stream in configuration.detector.spec.streams}
        if self._writer is not None:
            metadata: Mapping[str, JsonValue] = episode.rendered.get("metadata") or {}
            for write in scenarios.start_scenario(scenario, episode, metadata):
                self._writer.put_change(write)
        return scenario, Documents(name, f"{database}/{rule.name}/{name}", streams, configuration.decoders, above)

    def samples(self, episode: Episode, samples: Sequence[EpisodeSample]) -> None:
        """Convert them to documents; batches that are large enough are queued."""
        progress = self._progress[episode.id]
        while samples:
            now, samples = progress.parted(samples)
            self._convert(progress, now)
            if samples:
                self._renew(progress, min(sample.time for sample in samples))

    def _convert(self, progress: ScenarioProgress, samples: Iterable[EpisodeSample]) -> None:
        """Add the samples to the current scenario, as documents."""
        for sample in samples:
            converted = progress.documents.make(sample)
            progress.scenario.note_sample(sample.client, sample.stream, sample.time)
            progress.undecoded += converted.undecoded
            if converted.cut:
                self._lose(progress.scenario, 1, f"too large: {converted.cut}")
            self._add(progress.scenario, converted)

    def _renew(self, progress: ScenarioProgress, begin: int) -> None:
        """Complete the scenario; the episode continues in the next one."""
        self._finish(progress, Completion(), continues=True)
        progress.continue_in(*self._open(progress.episode, str(begin), resumed=False))
        self._convert(progress, list(progress.latest.values()))

    def _add(self, scenario: Scenario, converted: ConvertedDocument) -> None:
        document = converted.document if not converted.files else self._with_files(scenario, converted)
        scenario.messages[converted.collection] += 1
        scenario.bytes += len(document)
        batch = self._batches.get(converted.collection)
        if batch is not None and batch.bytes + len(document) > BATCH_BYTES:
            self._flush(converted.collection)
            batch = None
        if batch is None:
            if not self._batches:
                self._due = time.monotonic() + FLUSH
            batch = self._batches[converted.collection] = _Batch()
        batch.documents.append(document)
        batch.owners[scenario.id] += 1
        batch.bytes += len(document)
        if len(batch.documents) >= BATCH_DOCUMENTS:
            self._flush(converted.collection)

    def _with_files(self, scenario: Scenario, converted: ConvertedDocument) -> bytes:
        """The document, after writing the files that it refers to; it names those that could not be written."""
        if self.parameters.dry_run or self._folder is None:
            scenario.files += len(converted.files)
            return converted.document
        without: dict[str, str] = {}
        for each in converted.files:
            try:
                self._folder.write(each)
                scenario.files += 1
                scenario.bytes += len(each.content)
            except FolderError as error:
                without[each.path] = str(error)
                self._lose(scenario, 1, str(error))
        if not without:
            return converted.document
        missing = [{"file": path, "error": why} for path, why in without.items()]
        return bson_bytes({**bson.decode(converted.document), "filesMissing": missing})

    def _flush(self, collection: str) -> None:
        """Enqueue the documents of a collection."""
        batch = self._batches.pop(collection)
        if self._writer is None:
            return

        def losing(count: int, why: str) -> None:
            self.context.lose("database documents", count, why)

        write = Write(self.parameters.database, collection, batch.documents, losing=losing)
        if self._writer.put(write, self.context.closing):
            return
        open_ones = {each.scenario.id: each.scenario for each in self._progress.values()}
        why = "the queue is full" if not self._writer.away else "the queue is full while the database is unavailable"
        for name, count in batch.owners.items():
            if name in open_ones:  # otherwise it failed in the meantime
                self._lose(open_ones[name], count, why)
            else:
                losing(count, why)

    def completed(self, episode: Episode, completion: Completion) -> None:
        """Enqueue the request that completes the scenario, or records why it is incomplete."""
        progress = self._progress[episode.id]
        progress.episode = episode
        self._finish(progress, completion, continues=False)
        del self._progress[episode.id]

    def _finish(self, progress: ScenarioProgress, completion: Completion, *, continues: bool) -> None:
        for collection in list(self._batches):
            self._flush(collection)
        scenario, episode = progress.scenario, progress.episode
        incomplete = scenarios.why_incomplete(scenario, None if continues else episode, completion)

        def confirm(complete: bool, why: str) -> None:
            progress.trouble = progress.trouble or incomplete or ("" if complete else why)
            if not continues:
                state = OutcomeState.FAILED if progress.trouble else OutcomeState.DONE
                message = progress.trouble or ("dryRun: nothing was written" if self.parameters.dry_run else "")
                self._report(episode, state, message, progress, completion)

        if self._writer is None:
            confirm(not incomplete, incomplete)
            return
        detector = self.context.configuration().detector
        for write in scenarios.finish(scenario, episode, completion, detector, incomplete):
            self._writer.put_change(write, confirm if write.completes else None)

    def wake(self) -> float | None:
        """Enqueue documents that have waited long enough. The first call also connects, to resume an earlier run."""
        if not self._awake:
            self._awake = True
            try:
                self._connect()
            except ActionError as error:
                _log.error("action %s of EventRule %s: %s", self.context.action, self.context.rule.name, error)
        self._report_availability()
        if not self._batches:
            return None
        left = self._due - time.monotonic()
        if left > 0:
            return left
        for collection in list(self._batches):
            self._flush(collection)
        return None

    def _report_availability(self) -> None:
        """Report for each open episode whether its documents are waiting for the server."""
        away = self._writer.away if self._writer is not None else ""
        if bool(away) != self._reported_away:
            self._reported_away = bool(away)
            for progress in self._progress.values():
                self._report(progress.episode, OutcomeState.RUNNING, away and f"the database is unavailable: {away}")

    def close(self) -> None:
        """Release the queue; the last action that does so waits a few seconds for it to empty."""
        for collection in list(self._batches):
            self._flush(collection)
        if self._place is not None:
            release(self._place)
            self._place = self._writer = None

    def _connect(self) -> None:
        """Connect to the Detector's current database. Raises ActionError."""
        place = self.context.configuration().detector.spec.database
        if self.parameters.dry_run or place is None or place == self._place:
            return
        writer = acquire(place, self.context.lose)
        if self._place is not None:
            release(self._place)
        self._place, self._writer = place, writer
        self._folder = None
        if place.files is not None:
            self._folder = AttachmentFolder(
                Path(place.files.path), place.files.bytes.bytes if place.files.bytes else None
            )
        rule = self.context.rule.name
        behind = (self.parameters.database, self.context.holder, rule, self.context.action)
        if writer.first_time(behind):
            writer.put_change(scenarios.mark_interrupted(*behind))

    def _lose(self, scenario: Scenario, count: int, why: str) -> None:
        scenario.lost[why] += count
        self.context.lose("database documents", count, why)

    def _report(
        self,
        episode: Episode,
        state: OutcomeState,
        message: str = "",
        progress: ScenarioProgress | None = None,
        completion: Completion | None = None,
    ) -> None:
        progress = progress or self._progress[episode.id]
        scenario = progress.scenario
        messages = progress.messages + scenario.messages
        files = progress.files + scenario.files
        details: dict[str, JsonValue] = {
            "database": scenario.database,
            "scenario": scenario.id,
            "scenarios": progress.scenarios,
            "documents": dict(sorted(messages.items())),
            "filesWritten": files,
            "complete": state is OutcomeState.DONE and not self.parameters.dry_run,
        }
        if progress.undecoded:
            details["undecoded"] = progress.undecoded
        if self._writer is not None:
            details["waitingBytes"] = self._writer.waiting
        lost = progress.lost + sum(scenario.lost.values()) + (0 if completion is None else completion.missing)
        where = (str(self._folder.path / scenario.database / episode.rule),) if files and self._folder else ()
        size = progress.bytes + scenario.bytes
        self.context.report(episode, Outcome(state, message, sum(messages.values()), size, lost, where, details))
