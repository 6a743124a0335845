"""A run of mining: the workers mine the recordings without a result, then the dataset is written from all results.

A result is identified by content, rules and version. A run may therefore be killed and restarted, and several runs may
share the work in one folder: each writes its own results, and the run that finds all of them writes the dataset.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import msgspec

from detector.mining.cache import Cache, CacheEntry, job_digest, mined_in, read_entry
from detector.mining.dataset import EPISODES, TABLES, MinedRecording, write_dataset
from detector.mining.sources import InputRecording, RecordingPreview, preview, stamp_of
from detector.mining.tasks import CutRecording, JobResult, mined_rule, records, rule_keys, run_jobs, with_dependencies
from detector.mining.work import MiningJob, MiningProblem, RecordingResult
from detector.mining.workers import LostWorker, Workers
from wayside.api import Detector, EventRule

CLIPS = "clips"
CACHE = ".cache"
_READERS = 8
"""Number of threads that identify recordings."""


class WorkShare(NamedTuple):
    """A part of the work; the rest is left to others."""

    number: int
    """From 0."""
    of: int

    def contains(self, content: str) -> bool:
        """Whether the recording of this content is part of it."""
        return int(content[:8], 16) % self.of == self.number


class MiningProgress(Protocol):
    """Observes the progress of a run."""

    def expect(self, recordings: int, amount: int) -> None:
        """The remaining work: recordings, and their bytes."""

    def done(self, amount: int) -> None:
        """One is done."""


@dataclass
class MiningRun:
    """The result of a run."""

    recordings: int
    mined: int = 0
    """Number of recordings that had remaining work."""
    rules_run: set[str] = field(default_factory=set)
    complete: bool = True
    """Whether the dataset was written, or is up to date; otherwise other shares are not done yet."""
    cut: list[CutRecording] = field(default_factory=list)
    """The recordings that were cut into pieces."""
    changed: bool = False
    """Whether the dataset was written."""


def run_mining(
    sources: Sequence[InputRecording],
    output: Path,
    detector: Detector,
    rules: Sequence[EventRule],
    workers: Workers,
    watch: MiningProgress,
    *,
    record: bool = False,
    share: WorkShare | None = None,
) -> MiningRun:
    """Mine the recordings that have no result yet, and write the dataset.

    Args:
        sources: the recordings, in the order in which the dataset has them.
        output: its folder, created if it is missing.
        detector: the Detector of the rules.
        rules: the rules that it selects.
        workers: the workers that run the jobs.
        watch: observes the progress.
        record: whether record actions run.
        share: the part that is done here; None: all.

    Raises:
        OSError: the output cannot be written.
    """
    cache = Cache(output / CACHE)
    rules = [mined_rule(rule, record=record) for rule in rules]
    work = _Work(output, detector, {rule.name: rule for rule in rules}, rule_keys(detector, rules), record)
    seen = _previews(sources, cache)
    entries = _Entries(cache, work.keys)
    jobs: dict[str, tuple[MiningJob, int]] = {}
    for source in sources:
        found = seen[source]
        if isinstance(found, RecordingPreview) and found.content not in jobs and (left := entries.left(found.content)):
            jobs[found.content] = work.job(source, found.content, left), found.bytes
    own = {content: each for content, each in jobs.items() if share is None or share.contains(content)}
    run = MiningRun(len(sources), len(own), {name for job, _ in own.values() for name in job.wanted})
    watch.expect(len(own), sum(size for _, size in own.values()))
    left_of = {content: job.wanted for content, (job, _) in own.items()}
    for done in run_jobs(own.values(), workers, run.cut):
        content = done.job.content
        cache.put(content, work.entry(done))
        left_of[content] -= done.rules
        if not left_of[content]:
            watch.done(own[content][1])
    entries = _Entries(cache, work.keys)
    run.complete = not any(entries.left(content, failed_too=True) for content in jobs)
    if run.complete:
        with (output / CACHE / "lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)  # two shares may finish at the same time
            run.changed = _write(output, sources, seen, entries, work)
    return run


class _Work(NamedTuple):
    """The work for each recording."""

    output: Path
    detector: Detector
    rules: Mapping[str, EventRule]
    keys: Mapping[str, str]
    record: bool

    def job(self, source: InputRecording, content: str, wanted: frozenset[str]) -> MiningJob:
        evaluated = [self.rules[name] for name in sorted(with_dependencies(wanted, self.rules))]
        clips = None
        if self.record and any(records(self.rules[name]) for name in wanted):
            clips = str((self.output / CLIPS / self._folder(content, wanted)).resolve())
        return MiningJob(source, content, self.detector, evaluated, wanted, clips)

    def entry(self, done: JobResult) -> CacheEntry:
        """The cache entry of a result."""
        result = done.result
        if isinstance(result, LostWorker):
            result = msgspec.msgpack.encode(RecordingResult(flaws=[MiningProblem("failed", result.reason)]))
        keys = {name: self.keys[name] for name in sorted(done.rules)}
        clips = None if done.job.clips is None else Path(done.job.clips).name
        entry = CacheEntry(keys, result, clips)
        entry.failed = mined_in(entry).is_failed
        return entry

    def _folder(self, content: str, wanted: frozenset[str]) -> str:
        return f"{content[:12]}-{job_digest({name: self.keys[name] for name in wanted})[:8]}"


class _Entries:
    """The cached results of each recording, and which rules of which entry count."""

    def __init__(self, cache: Cache, keys: Mapping[str, str]) -> None:
        self._keys = keys
        self._by_content: dict[str, dict[Path, frozenset[str]]] = {}
        self._failed: set[Path] = set()
        for content, paths in cache.entries().items():
            covered: set[str] = set()
            for path in paths:  # failed entries sort after successful ones of the same rules, by their names
                entry = read_entry(path)
                if entry is None:
                    continue
                own = {name for name, key in entry.keys.items() if keys.get(name) == key} - covered
                if own:
                    self._by_content.setdefault(content, {})[path] = frozenset(own)
                    if entry.failed:
                        self._failed.add(path)
                    else:
                        covered |= own

    def left(self, content: str, *, failed_too: bool = False) -> frozenset[str]:
        """The rules that have not been run over it; `failed_too`: failed ones count as run."""
        done = self._by_content.get(content, {})
        return frozenset(self._keys).difference(
            *(names for path, names in done.items() if failed_too or path not in self._failed)
        )

    def used(self, content: str) -> dict[Path, frozenset[str]]:
        """The entries that count, each with its rules: one per rule; a failure only if there is nothing else."""
        done = self._by_content.get(content, {})
        good = {path: names for path, names in done.items() if path not in self._failed}
        covered = frozenset[str]().union(*good.values())
        bad = {path: names - covered for path, names in done.items() if path in self._failed and names - covered}
        return good | bad


def _previews(
    sources: Sequence[InputRecording], cache: Cache
) -> dict[InputRecording, RecordingPreview | MiningProblem]:
    """The identity of each recording, or why it cannot be read."""

    def seen(source: InputRecording) -> tuple[str | None, RecordingPreview | MiningProblem, bool]:
        try:
            stamp = stamp_of(source)
            known = cache.preview(source, stamp) if stamp is not None else None
            return stamp, known or preview(source), known is None
        except FileNotFoundError:
            return None, MiningProblem("unreadable", "there is no such file: correct the name"), False
        except OSError as error:
            return None, MiningProblem("unreadable", f"cannot read it: {error.strerror or error}"), False

    with ThreadPoolExecutor(_READERS) as pool:
        found_previews = dict(zip(sources, pool.map(seen, sources), strict=True))
    cache.store_previews(
        (source, stamp, found)
        for source, (stamp, found, new) in found_previews.items()
        if new and isinstance(found, RecordingPreview)
    )
    return {source: found for source, (_, found, _) in found_previews.items()}


def _write(
    output: Path,
    sources: Sequence[InputRecording],
    seen: Mapping[InputRecording, RecordingPreview | MiningProblem],
    entries: _Entries,
    work: _Work,
) -> bool:
    """Write the dataset unless it is up to date; returns whether it was written."""
    used = {
        source: entries.used(found.content) if isinstance(found, RecordingPreview) else {}
        for source, found in seen.items()
    }
    state = [
        [source.name, str(seen[source]), sorted((path.name, sorted(names)) for path, names in used[source].items())]
        for source in sources
    ]
    digest = hashlib.blake2b(json.dumps([state, sorted(work.keys.items()), work.record]).encode()).hexdigest()
    written = output / CACHE / "written"
    there = all((output / f"{name}.parquet").exists() for name in TABLES) and (output / EPISODES).is_dir()
    if there and written.exists() and written.read_text() == digest:
        return False
    written.unlink(missing_ok=True)
    if work.record:
        _forget_clips(output / CLIPS, {path for of_one in used.values() for path in of_one})
    recordings = [_recording(source, seen[source], used[source]) for source in sources]
    write_dataset(output, recordings, sorted(work.rules), with_clips=work.record)
    partial = written.with_name(f"written.{os.getpid()}")
    partial.write_text(digest)
    partial.replace(written)
    return True


def _forget_clips(folder: Path, used: Iterable[Path]) -> None:
    """Remove the clips that belong to no episode of the dataset any more."""
    kept = {entry.clips for path in used if (entry := read_entry(path)) is not None}
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name not in kept:
            shutil.rmtree(path)


def _recording(
    source: InputRecording, seen: RecordingPreview | MiningProblem, used: Mapping[Path, frozenset[str]]
) -> MinedRecording:
    if isinstance(seen, MiningProblem):
        return MinedRecording(source.name, "", lambda: [RecordingResult(flaws=[seen])])
    return MinedRecording(source.name, seen.content, _reader(used))


def _reader(used: Mapping[Path, frozenset[str]]) -> Callable[[], Sequence[RecordingResult]]:
    def parts() -> list[RecordingResult]:
        found = []
        for path, names in used.items():
            entry = read_entry(path)
            if entry is None:
                continue
            mined = mined_in(entry)
            folder = "" if entry.clips is None else f"{CLIPS}/{entry.clips}/"
            mined.episodes = [episode for episode in mined.episodes if episode.rule in names]
            mined.counts = [count for count in mined.counts if count.rule in names]
            mined.flaws = [flaw for flaw in mined.flaws if flaw.rule is None or flaw.rule in names]
            mined.clips = {each: [folder + name for name in names] for each, names in mined.clips.items()}
            found.append(mined)
        return found

    return parts
