"""The database action: it turns what it is told of episodes into requests, and reports what became of them."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bson

from detector.actions.base import Action, ActionError, Setting
from detector.actions.database import scenario as scenarios
from detector.actions.database.documents import Documents, Made
from detector.actions.database.folder import Folder, FolderError
from detector.actions.database.scenario import Scenario
from detector.actions.database.store import Store
from detector.actions.database.stores import acquire, release
from detector.actions.database.values import encoded
from detector.actions.database.work import BATCH_BYTES, BATCH_DOCUMENTS, Write
from detector.actions.episode import Completion, Episode, EpisodeSample, Outcome, OutcomeState
from wayside.api.actions.database import Attachments, DatabaseAction
from wayside.api.base import JsonValue
from wayside.api.database import Database as Place

_log = logging.getLogger(__name__)

FLUSH = 0.2
"""Documents wait at most so many seconds for others to be sent with."""


@dataclass(slots=True)
class _Batch:
    """Documents of one collection that are to be sent together."""

    documents: list[bytes] = field(default_factory=list)
    owners: Counter[str] = field(default_factory=Counter)
    bytes: int = 0


@dataclass(slots=True)
class _Work:
    """One scenario that is being written."""

    episode: Episode
    scenario: Scenario
    documents: Documents
    undecoded: int = 0


class Database(Action[DatabaseAction]):
    """Writes each episode as a scenario."""

    Parameters = DatabaseAction

    def __init__(self, parameters: DatabaseAction, setting: Setting) -> None:
        super().__init__(parameters, setting)
        self._place: Place | None = None
        self._store: Store | None = None
        self._folder: Folder | None = None
        self._works: dict[str, _Work] = {}
        self._batches: dict[str, _Batch] = {}
        self._due = 0.0
        self._awake = False
        self._told_away = False

    def started(self, episode: Episode) -> None:
        """Make the scenario known in the database, as one that is not complete."""
        self._connect()
        rule = self.setting.rule
        name = scenarios.scenario_id(episode, self.setting.action)
        database = self.parameters.database
        scenario = Scenario(name, self.setting.holder, self.setting.action, database, rule, episode.resumed)
        if why := episode.unrendered.get("metadata"):
            scenario.lost[f"metadata: {why}"] += 1
        around = self.setting.surroundings()
        above = None
        if around.detector.spec.database is not None and around.detector.spec.database.files is not None:
            above = (self.parameters.files or Attachments()).above.bytes
        streams = {stream.name: stream for stream in around.detector.spec.streams}
        place = f"{database}/{rule.name}/{name}"
        self._works[episode.id] = _Work(episode, scenario, Documents(name, place, streams, around.decoders, above))
        if self._store is not None:
            metadata: Mapping[str, JsonValue] = episode.rendered.get("metadata") or {}
            for write in scenarios.begin(scenario, episode, metadata):
                self._store.put_change(write)
        self._report(episode, OutcomeState.RUNNING)

    def samples(self, episode: Episode, samples: Sequence[EpisodeSample]) -> None:
        """Turn them into documents; those that are many enough are queued."""
        work = self._works[episode.id]
        for sample in samples:
            made = work.documents.make(sample)
            work.scenario.saw(sample.client, sample.stream, sample.time)
            work.undecoded += made.undecoded
            if made.cut:
                self._lose(work.scenario, 1, f"too large: {made.cut}")
            self._add(work.scenario, made)

    def _add(self, scenario: Scenario, made: Made) -> None:
        document = made.document if not made.files else self._with_files(scenario, made)
        scenario.messages[made.collection] += 1
        scenario.bytes += len(document)
        batch = self._batches.get(made.collection)
        if batch is not None and batch.bytes + len(document) > BATCH_BYTES:
            self._flush(made.collection)
            batch = None
        if batch is None:
            if not self._batches:
                self._due = time.monotonic() + FLUSH
            batch = self._batches[made.collection] = _Batch()
        batch.documents.append(document)
        batch.owners[scenario.id] += 1
        batch.bytes += len(document)
        if len(batch.documents) >= BATCH_DOCUMENTS:
            self._flush(made.collection)

    def _with_files(self, scenario: Scenario, made: Made) -> bytes:
        """The document, once the files that it refers to are written; it says which could not be."""
        if self.parameters.dry_run or self._folder is None:
            scenario.files += len(made.files)
            return made.document
        without: dict[str, str] = {}
        for each in made.files:
            try:
                self._folder.write(each)
                scenario.files += 1
                scenario.bytes += len(each.content)
            except FolderError as error:
                without[each.path] = str(error)
                self._lose(scenario, 1, str(error))
        if not without:
            return made.document
        missing = [{"file": path, "error": why} for path, why in without.items()]
        return encoded({**bson.decode(made.document), "filesMissing": missing})

    def _flush(self, collection: str) -> None:
        """Queue what there is for a collection."""
        batch = self._batches.pop(collection)
        if self._store is None:
            return

        def losing(count: int, why: str) -> None:
            self.setting.lose("database documents", count, why)

        write = Write(self.parameters.database, collection, batch.documents, losing=losing)
        if self._store.put(write, self.setting.closing):
            return
        works = {work.scenario.id: work.scenario for work in self._works.values()}
        why = "no room in the queue" if not self._store.away else "no room while the database is away"
        for name, count in batch.owners.items():
            if name in works:  # else it failed meanwhile
                self._lose(works[name], count, why)
            else:
                losing(count, why)

    def completed(self, episode: Episode, completion: Completion) -> None:
        """Queue what makes the scenario complete, or what says why it is not."""
        for collection in list(self._batches):
            self._flush(collection)
        work = self._works.pop(episode.id)
        scenario = work.scenario
        incomplete = scenarios.why_incomplete(scenario, episode, completion)
        if self._store is None:
            state = OutcomeState.FAILED if incomplete else OutcomeState.DONE
            self._report(episode, state, incomplete or "dryRun: nothing was written", work, completion)
            return

        def confirm(complete: bool, why: str) -> None:
            message = incomplete or ("" if complete else why)
            state = OutcomeState.FAILED if message else OutcomeState.DONE
            self._report(episode, state, message, work, completion)

        detector = self.setting.surroundings().detector
        for write in scenarios.finish(scenario, episode, completion, detector):
            self._store.put_change(write, confirm if write.completes else None)

    def wake(self) -> float | None:
        """Queue what has waited long enough. The first time, what an earlier run left on disk is taken up."""
        if not self._awake:
            self._awake = True
            try:
                self._connect()
            except ActionError as error:
                _log.error("action %s of EventRule %s: %s", self.setting.action, self.setting.rule.name, error)
        self._tell_whether_away()
        if not self._batches:
            return None
        left = self._due - time.monotonic()
        if left > 0:
            return left
        for collection in list(self._batches):
            self._flush(collection)
        return None

    def _tell_whether_away(self) -> None:
        """Say of each open episode that its documents have to wait, or no longer have to."""
        away = self._store.away if self._store is not None else ""
        if bool(away) != self._told_away:
            self._told_away = bool(away)
            for work in self._works.values():
                self._report(work.episode, OutcomeState.RUNNING, away and f"the database is away: {away}")

    def close(self) -> None:
        """Let go of the queue; the last action that does waits for it, a few seconds."""
        for collection in list(self._batches):
            self._flush(collection)
        if self._place is not None:
            release(self._place)
            self._place = self._store = None

    def _connect(self) -> None:
        """Use the database that the Detector has now. Raises ActionError."""
        place = self.setting.surroundings().detector.spec.database
        if self.parameters.dry_run or place is None or place == self._place:
            return
        store = acquire(place, self.setting.lose)
        if self._place is not None:
            release(self._place)
        self._place, self._store = place, store
        self._folder = None
        if place.files is not None:
            self._folder = Folder(Path(place.files.path), place.files.bytes.bytes if place.files.bytes else None)
        rule = self.setting.rule.name
        behind = (self.parameters.database, self.setting.holder, rule, self.setting.action)
        if store.first_time(behind):
            store.put_change(scenarios.leave_behind(*behind))

    def _lose(self, scenario: Scenario, count: int, why: str) -> None:
        scenario.lost[why] += count
        self.setting.lose("database documents", count, why)

    def _report(
        self,
        episode: Episode,
        state: OutcomeState,
        message: str = "",
        work: _Work | None = None,
        completion: Completion | None = None,
    ) -> None:
        work = work or self._works[episode.id]
        scenario = work.scenario
        details: dict[str, JsonValue] = {
            "database": scenario.database,
            "scenario": scenario.id,
            "documents": dict(sorted(scenario.messages.items())),
            "filesWritten": scenario.files,
            "complete": state is OutcomeState.DONE and not self.parameters.dry_run,
        }
        if work.undecoded:
            details["undecoded"] = work.undecoded
        if self._store is not None:
            details["waitingBytes"] = self._store.waiting
        lost = sum(scenario.lost.values()) if completion is None else scenarios.missing(scenario, completion)
        files = (str(self._folder.path / work.documents.place),) if scenario.files and self._folder else ()
        samples = sum(scenario.messages.values())
        self.setting.report(episode, Outcome(state, message, samples, scenario.bytes, lost, files, details))
