"""Decides how a recording is cut into pieces, and for which rules the cut is exact.

A piece computes the observations of its ticks from its own samples and those shortly before: windows, clients and
staleness reach no further back. State that reaches further (episodes, `for`, `cooldown`) is computed afterwards, from
the observations of all pieces in order: see `joining`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from detector.assembly import RuleIndex, make_engine, stream_readers
from detector.engine.buffering.buffer import HOUSEKEEPING
from detector.engine.columns.group import names_of, signals_of
from detector.engine.engine import Engine
from detector.replay.gathering import Recording
from detector.replay.mcap_file import mcap_chunks
from detector.replay.recorded_types import with_recorded_types
from wayside.api import Detector, EventRule
from wayside.api.detector import Clock
from wayside.api.eventrule import Aggregate
from wayside.rules import ClientSubject, CompiledRule, FleetSubject

_LEAST = 10
"""Minimum length of a piece, as a multiple of the part that it reads before its beginning."""
START, END = 0, 2**63 - 1
"""Stand for the ends of a recording; nanoseconds."""


class PieceTimes(NamedTuple):
    """The times of one piece; nanoseconds."""

    reads: int
    """It reads samples from here on."""
    after: int
    """Its ticks and samples are later than this time,"""
    until: int
    """and up to this one."""


class Cutting(NamedTuple):
    """How a recording is cut."""

    spans: list[PieceTimes]
    rules: frozenset[str]
    """The rules for which the cut is exact."""
    whole: dict[str, str]
    """The other rules, with the reasons."""


def cutting_of(recording: Recording, detector: Detector, rules: Sequence[EventRule], pieces: int) -> Cutting | None:
    """How to cut a recording into that many pieces; None if this is impossible.

    Raises:
        DetectorError: the Detector cannot run.
        RecordingError: the recording is damaged.
    """
    chunks = [] if any(path.is_dir() for path in recording) else [mcap_chunks(path) for path in recording]
    if pieces < 2 or not chunks or any(each is None for each in chunks):
        return None
    completed = with_recorded_types(detector, recording)
    readers = stream_readers(completed)
    compiled, _ = RuleIndex().compile(rules, completed, readers.fields, readers.places)
    engine = make_engine(completed, readers, holder=detector.name, start=0)
    engine.set_rules(compiled)
    reasons = {rule.name: why_whole(engine, rule) for rule in compiled}
    exact = frozenset(name for name, why in reasons.items() if why is None)
    if not exact:
        return None
    warmup = warmup_of(completed, [rule for rule in compiled if rule.name in exact])
    spans = _spans(sorted(each for of_one in chunks for each in of_one or ()), pieces, warmup)
    whole = {name: why for name, why in reasons.items() if why is not None}
    return Cutting(spans, exact, whole) if len(spans) > 1 else None


def why_whole(engine: Engine, rule: CompiledRule) -> str | None:
    """Why the rule needs the whole recording in order; None: it does not. The engine has the rule."""
    spec = engine.detector.spec
    if spec.clock is Clock.DATA:
        return "clock Data"
    if any(stream.latched for stream in spec.streams):
        return "latched streams"
    if any(stream.items is not None for stream in spec.streams):
        return "streams with items"
    if not isinstance(rule.subject, ClientSubject):
        return "the fleet" if isinstance(rule.subject, FleetSubject) else "pairs"
    if any(signal.rule is not None for signal in signals_of(rule)):
        return "other rules' episodes"
    if rule.has_margin:
        return "margin"
    if rule.maximum_per_hour is not None:
        return "maxEpisodesPerHour"
    if rule.actions:
        return "record actions"
    if rule.every_ns is None:
        return "evaluation with samples or on demand"
    if any(signal.aggregate is Aggregate.AGE for signal in signals_of(rule)):
        return "aggregate Age"
    if rule.name not in engine.in_columns:
        return "not in columns"
    streams = [stream for stream in spec.streams if stream.name in rule.streams or "streams" in names_of(rule)]
    if any(spec.stale_after_ns(stream) is None for stream in streams):
        return "staleAfter Never"
    return None


def warmup_of(detector: Detector, rules: Sequence[CompiledRule]) -> int:
    """How far back observations and the presence of clients reach; nanoseconds."""
    spec = detector.spec
    kept = [spec.buffer_duration_ns(stream) for stream in spec.streams]
    stale = [spec.stale_after_ns(stream) or 0 for stream in spec.streams]
    every = max(rule.every_ns or 0 for rule in rules)
    # The oldest sample of a window may be compared with the previous one, which is not stale then.
    return max(kept) + max(stale) + spec.client_timeout.ns + 2 * (every + HOUSEKEEPING)


def _spans(chunks: Sequence[tuple[int, int]], pieces: int, warmup: int) -> list[PieceTimes]:
    """Pieces of about equal size that begin with chunks; fewer if they would be too short."""
    total, size = sum(size for _, size in chunks), 0
    cuts = [START]
    for start, length in chunks:
        if size >= total * len(cuts) / pieces and start - 1 - (cuts[-1] or chunks[0][0]) >= _LEAST * warmup:
            cuts.append(start - 1)
        size += length
    if len(cuts) > 1 and chunks[-1][0] - cuts[-1] < warmup:
        cuts.pop()
    return [PieceTimes(max(after - warmup, 0), after, until) for after, until in pairwise([*cuts, END])]
