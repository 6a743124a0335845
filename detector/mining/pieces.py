"""A worker's processing of a piece of a recording: the changes of observations and signals within it."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from detector.engine.columns.block import Block, Track
from detector.engine.columns.fleets import FleetBlock
from detector.engine.columns.pairs import PairBlock
from detector.engine.columns.table import Truths
from detector.engine.columns.verdicts import Codes
from detector.engine.engine import Engine
from detector.engine.episodes.episodes import OUTSIDE, TRUE, UNTIL
from detector.engine.samples.sample import Arrival
from detector.mining.cutting import END, PieceTimes
from detector.mining.work import tuned
from detector.replay.batches import PAUSE, merged_batches, parts_of
from detector.replay.mcap_file import read_mcap
from detector.replay.message import Truncation
from detector.replay.recorded_types import with_recorded_types
from detector.replay.replaying import Replay, ReplayResult
from detector.replay.routing import MessageRouter
from detector.results.changes import Changes
from detector.results.quality import Arrivals
from detector.results.series import Bytes, Doubles, Integers
from wayside.api import Detector, EventRule
from wayside.expressions.columns.values import Tag
from wayside.inputerror import InputError

LOST = 255
"""Stands in for an observation: the client is lost. No observation has this value."""


class PieceJob(NamedTuple):
    """A piece, and the rules to evaluate, for all of which cutting is exact."""

    span: PieceTimes
    files: tuple[str, ...]
    detector: Detector
    rules: Sequence[EventRule]


class SignalChanges(NamedTuple):
    """The changes of one signal of one client; arrays of equal length."""

    times: Integers
    values: Doubles
    """Texts are indices into `texts` of the piece."""
    tags: Bytes
    kinds: frozenset[int]
    """All tags that occur, including those of left-out changes."""


class _Seen(NamedTuple):
    """The observations and signals of a rule for one client and element."""

    times: Integers
    codes: Bytes
    """Observations, or LOST, each valid from its time."""
    signals: dict[str, SignalChanges]
    """Complete wherever an episode may be open; elsewhere with gaps."""


@dataclass
class PieceResult:
    """The result of a piece."""

    flaw: str | None = None
    """Why the recording cannot be cut after all."""
    samples: int = 0
    first: int = 0
    last: int = 0
    """When its first and last sample were received."""
    seen: dict[tuple[str, str | None, str], _Seen] = field(default_factory=dict)
    """By rule, element and client."""
    texts: list[str] = field(default_factory=list)
    counts: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    """By rule: evaluations, unknown, errors."""
    arrivals: Arrivals = field(default_factory=Arrivals)
    unnamed: dict[str, int] = field(default_factory=dict)


def observe(job: PieceJob) -> PieceResult:
    """Process a piece. Everything for which cutting cannot be exact is a flaw."""
    tuned()
    try:
        return _observed(job)
    except (InputError, OSError) as error:
        return PieceResult(flaw=str(error))


def _observed(job: PieceJob) -> PieceResult:
    recording = tuple(map(Path, job.files))
    detector = with_recorded_types(job.detector, recording)
    router = MessageRouter(detector.spec.streams, str(recording[0]))
    cuts: list[Truncation] = []
    between = (job.span.reads, job.span.until)
    batches = merged_batches([read_mcap(path, router.wanted, cuts.append, between=between) for path in recording])
    found, recorder = PieceResult(), _Recorder(job.span.after)
    replay: Replay | None = None
    before = _Counted({}, {}, 0, 0)
    for part in _split(parts_of(router.arrivals(batches)), job.span.after):
        first = part[0].received
        if replay is None:
            replay = Replay(
                detector, job.rules, holder=detector.name, start=first - 1, outcome=ReplayResult(), observer=recorder
            )
        elif first - replay.engine.now > PAUSE:
            return PieceResult(flaw="it pauses for more than an hour")
        if first > job.span.after:
            if not found.samples:
                before = _begun(replay, job.span)
                found.first = first
            found.samples += len(part)
            found.last = part[-1].received
            deque(found.arrivals.watch_batches([part]), maxlen=0)
        replay.advance(part, part[-1].received)
    if replay is None:
        return found
    if not found.samples:
        before = _begun(replay, job.span)
    if job.span.until != END:
        replay.advance((), job.span.until)
    recorder.close(replay.engine.now)
    now = _counted(replay.engine)
    if cuts or recorder.odd or now.lost or now.unreadable != before.unreadable:
        return PieceResult(
            flaw="its end is missing, messages cannot be read, samples were dropped, or values are lists"
        )
    found.counts = {name: counts - before.rules.get(name, np.zeros(3, np.int64)) for name, counts in now.rules.items()}
    found.unnamed = {name: count - before.unnamed.get(name, 0) for name, count in now.unnamed.items()}
    found.seen, found.texts = recorder.seen(), [*recorder.texts]
    return found


def _split(parts: Iterable[Sequence[Arrival]], after: int) -> Iterator[Sequence[Arrival]]:
    """The parts; one that extends beyond the time is split there."""
    for part in parts:
        cut = bisect_right(part, after, key=attrgetter("received"))
        yield from (each for each in (part[:cut], part[cut:]) if each)


def _begun(replay: Replay, span: PieceTimes) -> _Counted:
    """Run the ticks before the piece; returns the counts up to there."""
    if span.after > replay.engine.now:
        replay.advance((), span.after)
    return _counted(replay.engine)


class _Counted(NamedTuple):
    """The counts of an engine."""

    rules: dict[str, NDArray[np.int64]]
    """Evaluations, unknown, errors."""
    unnamed: dict[str, int]
    unreadable: int
    lost: int
    """Samples dropped because of caps: which ones depends on everything before."""


def _counted(engine: Engine) -> _Counted:
    counters = engine.counters
    rules = {
        name: np.array([each.evaluations, each.unknowns, each.errors], np.int64)
        for name, each in counters.rules.items()
    }
    lost = engine.buffer.evicted + counters.crowded.total()
    return _Counted(rules, dict(counters.unnamed), counters.undecodable.total(), lost)


@dataclass
class _Group:
    """The rules of a group, and their noted changes."""

    tracks: Sequence[Track]
    every: int
    codes: list[Changes]
    signals: dict[int, tuple[Changes, Track, str]]
    """By index in the block: its changes, and a track that uses it under a name."""
    present: set[int] = field(default_factory=set)
    """The clients of the previous block."""
    last: int = 0
    """The last tick."""


class _Recorder:
    """Observes the engine of a piece."""

    def __init__(self, after: int) -> None:
        """It records changes after this time; before it, only the known clients."""
        self._after = after
        self._groups: dict[int, _Group] = {}
        self._numbers: dict[str, int] = {}
        self.texts: dict[str, int] = {}
        self.odd = False
        """Whether there are values other than numbers, booleans and texts."""

    def attend(self, engine: Engine) -> None:
        """See `ReplayObserver`."""

    def fleet(self, tracks: Sequence[Track], block: FleetBlock) -> None:
        """See `Observer`."""
        raise AssertionError("rules about the fleet are not cut")

    def pairs(self, track: Track, these: PairBlock) -> None:
        """See `Observer`."""
        raise AssertionError("rules about pairs are not cut")

    def clients(self, tracks: Sequence[Track], block: Block, codes: Codes, selected: Truths | None) -> None:
        """Record the changes in a block."""
        group = self._groups.get(id(tracks))
        if group is None:
            group = self._groups[id(tracks)] = _group(tracks)
        names = [self._numbers.setdefault(client, len(self._numbers)) for client in block.clients]
        numbers = np.array(names, np.int64)
        self._nobody_until(group, block.ticks[0])
        self._record_lost(group, group.present.difference(names), block.ticks[0])
        group.present, group.last = set(names), block.ticks[-1]
        if block.ticks[0] <= self._after:
            return
        none = np.zeros(block.shape, np.uint8)
        present = block.present
        for row, changes in enumerate(group.codes):
            changes.add(numbers, block.times, codes[row].astype(float), none, present)
        for at, (changes, track, name) in group.signals.items():
            self._signal(block, at, changes, track, name, numbers)

    def close(self, until: int) -> None:
        """All ticks up to this time have run."""
        for group in self._groups.values():
            self._nobody_until(group, until + 1)

    def seen(self) -> dict[tuple[str, str | None, str], _Seen]:
        """The recorded changes."""
        found: dict[tuple[str, str | None, str], _Seen] = {}
        names = [*self._numbers]
        for group in self._groups.values():
            signals: dict[int, dict[int, SignalChanges]] = {}
            for at, (changes, _, _) in group.signals.items():
                for client, times, values, tags in changes.by_client(None):
                    signals.setdefault(client, {})[at] = SignalChanges(
                        times, values, tags, frozenset(np.unique(tags).tolist())
                    )
            for track, changes in zip(group.tracks, group.codes, strict=True):
                for client, times, values, _ in changes.by_client(None):
                    codes = values.astype(np.uint8)
                    kept = _Relevant(times, codes)
                    own = signals.get(client, {})
                    found[track.rule.name, track.element.name, names[client]] = _Seen(
                        times, codes, {name: kept.of(own[at]) for name, at in track.signals.items() if at in own}
                    )
        return found

    def _signal(self, block: Block, at: int, changes: Changes, track: Track, name: str, numbers: Integers) -> None:
        column, shape = block.signals[at], block.shape
        tags = np.full(shape, Tag.NUMBER, np.uint8) if column.tags is None else column.tags.reshape(shape)
        self.odd |= bool((tags == Tag.OTHER).any())
        found = changes.add(numbers, block.times, column.values.reshape(shape), tags, block.present)
        for place in np.flatnonzero(tags[found.rows, found.ticks] == Tag.TEXT).tolist():
            point = int(found.rows[place]) * shape[1] + int(found.ticks[place])
            text = str(block.values(track, point)[name])
            found.values[place] = self.texts.setdefault(text, len(self.texts))

    def _nobody_until(self, group: _Group, tick: int) -> None:
        """Blocks without any client are not reported: the clients of the last block are lost at the next tick."""
        following = group.last + group.every
        if group.last and following < tick:
            self._record_lost(group, group.present, following)
            group.present = set()

    def _record_lost(self, group: _Group, clients: Set[int], tick: int) -> None:
        if not clients or tick <= self._after:
            return
        gone = np.array(sorted(clients), np.int64)
        shape, times = (len(gone), 1), np.array([tick], np.int64)
        for changes in group.codes:
            changes.add(gone, times, np.full(shape, float(LOST)), np.zeros(shape, np.uint8), None)
        for changes, _, _ in group.signals.values():
            changes.add(gone, times, np.zeros(shape), np.full(shape, Tag.ABSENT, np.uint8), None)


def _group(tracks: Sequence[Track]) -> _Group:
    every = tracks[0].rule.every_ns
    assert every is not None  # noqa: S101  rules that are cut have a period
    signals: dict[int, tuple[Changes, Track, str]] = {}
    for track in tracks:
        for name, at in track.signals.items():
            signals.setdefault(at, (Changes(), track, name))
    return _Group(tracks, every, [Changes() for _ in tracks], signals)


class _Relevant:
    """The times at which an episode of a subject may be open: other values affect nothing, and are the majority.

    At the beginning of a piece this is unknown. An observation that ends any episode closes it; one by which an episode
    may start opens it.
    """

    def __init__(self, times: Integers, codes: Bytes) -> None:
        self._times = times
        lost = codes == LOST
        ends = lost | (codes & OUTSIDE == UNTIL) | (codes & OUTSIDE == OUTSIDE)
        starts = ~lost & (codes & 3 == TRUE)
        decided = np.maximum.accumulate(np.where(ends | starts, np.arange(len(codes)), -1))
        self._behind = np.where(decided < 0, True, starts[np.maximum(decided, 0)])
        """Whether an episode may be open after each change."""
        self._before = np.concatenate(([True], self._behind[:-1]))
        opening = np.flatnonzero(self._behind & ~self._before)
        self._opens = np.concatenate((times[:1], times[opening]))

    def of(self, values: SignalChanges) -> SignalChanges:
        """The relevant changes, and the values valid at their beginning."""
        at = np.searchsorted(self._times, values.times, "right") - 1
        known = np.maximum(at, 0)
        kept = (at < 0) | self._behind[known] | (self._before[known] & (self._times[known] == values.times))
        holding = np.searchsorted(values.times, self._opens, "right") - 1
        kept[holding[holding >= 0]] = True
        return SignalChanges(values.times[kept], values.values[kept], values.tags[kept], values.kinds)
