"""The tasks of workers for a job: the whole of it, or pieces of its recording and the rules that need the whole.

A recording is cut only if it would delay the end: pieces cost slightly more than the whole. The key of a result is the
content of the recording, and a digest of everything that affects a rule's result.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from math import ceil
from pathlib import Path
from typing import NamedTuple

import msgspec

from detector.assembly import DetectorError
from detector.mining.cutting import Cutting, cutting_of
from detector.mining.joining import flaw_of, joined
from detector.mining.pieces import PieceJob, PieceResult, observe
from detector.mining.work import MiningJob, mine_recording
from detector.mining.workers import LostWorker, RemoteCall, Workers
from detector.replay.clips import RECORD
from detector.replay.message import RecordingError
from wayside.api import Detector, EventRule

_PER_WORKER = 2
"""Minimum number of calls per worker when a recording is cut."""


class JobResult(NamedTuple):
    """The result of a job, or of some of its rules."""

    job: MiningJob
    rules: frozenset[str]
    result: bytes | LostWorker


class CutRecording(NamedTuple):
    """How a recording was cut."""

    name: str
    pieces: int
    whole: Mapping[str, str]
    """The rules that ran over the whole recording, with the reasons."""


def run_jobs(jobs: Iterable[tuple[MiningJob, int]], workers: Workers, cut: list[CutRecording]) -> Iterator[JobResult]:
    """Run the jobs, each with the size of its recording in bytes; yields results when they are ready, by parts of the
    rules.

    Appends the recordings that were cut to `cut`.
    """
    # The largest first, to shorten the tail.
    ordered = sorted(jobs, key=lambda each: (-each[1], each[0].content))
    total = sum(size for _, size in ordered)
    calls: list[RemoteCall] = []
    of_pieces: dict[int, _Pieces] = {}
    for job, size in ordered:
        most = _PER_WORKER * workers.count
        cutting = _cutting(job, ceil(most * size / total)) if workers.count > 1 and total else None
        if cutting is None:
            calls.append(RemoteCall(mine_recording, job))
            continue
        cut.append(CutRecording(job.source.name, len(cutting.spans), cutting.whole))
        exact = job.wanted & cutting.rules
        pieces = _Pieces(_with(job, exact), cutting)
        of_pieces |= {id(call): pieces for call in pieces.calls}
        calls += [
            *([RemoteCall(mine_recording, _with(job, job.wanted - exact))] if job.wanted - exact else []),
            *pieces.calls,
        ]
    again: list[RemoteCall] = []
    for call, result in workers.run(calls):
        found = of_pieces.get(id(call))
        if found is None:
            yield JobResult(call.argument, call.argument.wanted, result)
        elif found.add_result(call, result):
            done = found.result()
            if done is None:
                again.append(RemoteCall(mine_recording, found.job))
            else:
                yield JobResult(found.job, found.job.wanted, done)
    for call, result in workers.run(again):
        yield JobResult(call.argument, call.argument.wanted, result)


def _cutting(job: MiningJob, count: int) -> Cutting | None:
    """How to cut the recording of a job; its errors are reported when it is mined."""
    if count < 2 or job.source.is_remote:
        return None
    try:
        cutting = cutting_of(tuple(map(Path, job.source.files)), job.detector, job.rules, count)
    except (RecordingError, DetectorError, OSError):
        return None
    return cutting if cutting is not None and job.wanted & cutting.rules else None


def _with(job: MiningJob, wanted: frozenset[str]) -> MiningJob:
    """The job for only some of its rules."""
    needed = with_dependencies(wanted, {rule.name: rule for rule in job.rules})
    return job._replace(wanted=wanted, rules=[rule for rule in job.rules if rule.name in needed])


class _Pieces:
    """The pieces of a recording, and their results until now."""

    def __init__(self, job: MiningJob, cutting: Cutting) -> None:
        self.job = job._replace(clips=None)
        given = job.source.files, job.detector, job.rules
        self.calls = [RemoteCall(observe, PieceJob(span, *given)) for span in cutting.spans]
        self._observed: dict[int, PieceResult] = {}

    def add_result(self, call: RemoteCall, result: PieceResult | LostWorker) -> bool:
        """Store the result of a piece; returns whether it was the last one."""
        found = PieceResult(flaw=result.reason) if isinstance(result, LostWorker) else result
        self._observed[[id(each) for each in self.calls].index(id(call))] = found
        return len(self._observed) == len(self.calls)

    def result(self) -> bytes | None:
        """The joined result; None: the recording must be mined as a whole."""
        pieces: Sequence[PieceResult] = [self._observed[at] for at in range(len(self.calls))]
        if flaw_of(pieces) is not None:
            return None
        return msgspec.msgpack.encode(joined(self.job, tuple(map(Path, self.job.source.files)), pieces))


_LAYOUT = 2
"""The version of the cached layout: results of earlier versions are not read."""


def rule_keys(detector: Detector, rules: Sequence[EventRule]) -> dict[str, str]:
    """By rule, a digest of it, of the rules that it reads, its models, the Detector with its maps, and this version.

    The rules have the actions that run (see `mined_rule`).
    """
    named = {rule.name: rule for rule in rules}
    common = [_LAYOUT, version("wayside"), detector.name, detector.namespace, detector.spec.model_dump(mode="json")]
    common += [_digest(Path(each.file)) for each in detector.spec.maps]
    keys = {}
    for rule in rules:
        seen = sorted(with_dependencies([rule.name], named))
        whole = [*common, [_document(named[name]) for name in seen]]
        keys[rule.name] = hashlib.blake2b(json.dumps(whole, sort_keys=True).encode(), digest_size=16).hexdigest()
    return keys


def mined_rule(rule: EventRule, *, record: bool) -> EventRule:
    """The rule without actions, except record actions if they run: no other affects the result."""
    actions = [action for action in rule.spec.actions if record and action.field == RECORD]
    return rule.model_copy(update={"spec": rule.spec.model_copy(update={"actions": actions})})


def records(rule: EventRule) -> bool:
    """Whether the rule has a record action."""
    return any(action.field == RECORD for action in rule.spec.actions)


def with_dependencies(names: Iterable[str], rules: Mapping[str, EventRule]) -> set[str]:
    """The rules, and those that their signals read, directly or indirectly. Missing ones are left out."""
    found: set[str] = set()
    left = [*names]
    while left:
        name = left.pop()
        if name in rules and name not in found:
            found.add(name)
            left += [signal.rule_name for signal in rules[name].spec.signals if signal.rule_name is not None]
    return found


def _document(rule: EventRule) -> object:
    """Everything in the rule that affects the result, with the content of its models."""
    files = [signal.model.file for signal in rule.spec.signals if signal.model is not None]
    return [rule.name, rule.spec.model_dump(mode="json"), [_digest(Path(file)) for file in files]]


def _digest(path: Path) -> str:
    try:
        return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()
    except OSError as error:
        return str(error)  # the rule is rejected
