"""Joins the pieces of a recording: episodes are computed over the observations of all pieces, in order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from detector.assembly import RuleIndex, stream_readers
from detector.engine.counters import Counters, RuleCounters
from detector.engine.episodes.current import DetectorIdentity
from detector.engine.episodes.episodes import Ended, EndReason, Started, SubjectState
from detector.engine.episodes.events import Event
from detector.engine.episodes.subjects import Subject
from detector.engine.evaluation.rule import RuleRun
from detector.engine.scoping.scopes import Candidate
from detector.mining.pieces import LOST, PieceResult, SignalChanges
from detector.mining.work import MiningJob, RecordingResult, RuleCount, in_their_order, job_holder
from detector.replay.batches import PAUSE
from detector.replay.gathering import Recording
from detector.replay.recorded_types import with_recorded_types
from detector.results.episodes import episodes_of
from detector.results.quality import Arrivals
from detector.results.series import Series, SeriesKind, SubjectTrace, Trace
from detector.results.tracing import series_of
from wayside.expressions.columns.values import Tag

_KNOWN = (Tag.NUMBER, Tag.BOOLEAN, Tag.TEXT)


def flaw_of(pieces: Sequence[PieceResult]) -> str | None:
    """Why the recording cannot be cut after all."""
    flaws = [piece.flaw for piece in pieces if piece.flaw is not None]
    there = [piece for piece in pieces if piece.samples]
    if not flaws and any(later.first - earlier.last > PAUSE for earlier, later in pairwise(there)):
        flaws.append("it pauses for more than an hour")
    if not flaws and not there:
        flaws.append("it contains no sample")
    return flaws[0] if flaws else None


def joined(job: MiningJob, recording: Recording, pieces: Sequence[PieceResult]) -> RecordingResult:
    """The result of a recording; the pieces, in order, have no flaw. The job's rules are those that they evaluated."""
    detector = with_recorded_types(job.detector, recording)
    readers = stream_readers(detector)
    compiled, _ = RuleIndex().compile(job.rules, detector, readers.fields, readers.places)
    there = [piece for piece in pieces if piece.samples]
    end = there[-1].last
    texts = _Texts()
    subjects = sorted({key for piece in pieces for key in piece.seen}, key=lambda key: (key[0], key[1] or "", key[2]))
    identity = DetectorIdentity(detector.name, job_holder(job), detector.namespace)
    runs = {rule.name: RuleRun(rule, identity, RuleCounters()) for rule in compiled}
    events: list[Event] = []
    traces = []
    for key in subjects:
        rule, element, client = key
        subject = Subject((client,), element)
        seen = [(piece.seen[key], piece.texts) for piece in pieces if key in piece.seen]
        names = dict.fromkeys(name for each, _ in seen for name in each.signals)
        values = {
            name: _whole([texts.common(each.signals[name], own) for each, own in seen if name in each.signals])
            for name in names
        }
        times = np.concatenate([each.times for each, _ in seen]).tolist()
        codes = np.concatenate([each.codes for each, _ in seen]).tolist()
        events += _stepped(runs[rule], subject, times, codes, end, _At(values, texts.texts))
        trace = SubjectTrace(rule, subject.text, subject.clients)
        trace.signals = {name: _series(each, texts.texts) for name, each in values.items()}
        traces.append(trace)
    arrivals, counters = Arrivals(), Counters()
    for piece in pieces:
        arrivals.follow(piece.arrivals)
        counters.unnamed.update(piece.unnamed)
    counts = {name: sum(piece.counts.get(name, 0) for piece in pieces) for name in sorted(runs)}
    mined = RecordingResult(
        episodes=in_their_order(episodes_of("", events, Trace(traces, end=end))),
        counts=[RuleCount(name, *map(int, np.broadcast_to(each, 3))) for name, each in counts.items()],
        streams=arrivals.by_stream(detector, counters),
        samples=sum(piece.samples for piece in pieces),
    )
    mined.begin, mined.end = arrivals.span
    return mined


def _stepped(
    run: RuleRun, subject: Subject, times: Sequence[int], codes: Sequence[int], end: int, values: _At
) -> Iterator[Event]:
    """The starts and ends of a subject's episodes: as in `groups`, over all ticks at once."""
    every = run.rule.every_ns
    assert every is not None  # noqa: S101  rules that are cut have a period
    ticks = range(times[0], end + 1, every)
    places = [(time - times[0]) // every for time in times]
    state = SubjectState()
    for code, time, begin, last in zip(codes, times, places, [*places[1:], len(ticks)], strict=True):
        if code == LOST:
            if state.is_open:
                state.end(time, run.timing)
                yield from _event(run, time, Ended(EndReason.CLIENT_LOST), Candidate(subject, {}, True, True))
            else:
                state.gap()
            continue
        first = begin
        while first < last:
            first, what, _ = state.run(ticks, first, last, run.timing, code)
            if what is not None:
                time_of = ticks[first]
                yield from _event(run, time_of, what, Candidate(subject, values.at(time_of), True, True))
                first += 1


def _event(run: RuleRun, time: int, what: Started | Ended, candidate: Candidate) -> Iterator[Event]:
    event = run.happened(time, what, candidate)
    if event is not None:
        yield event


class _Texts:
    """The texts of all pieces."""

    def __init__(self) -> None:
        self._places: dict[str, int] = {}
        self.texts: list[str] = []

    def common(self, values: SignalChanges, texts: Sequence[str]) -> SignalChanges:
        """The values, with texts as their indices here."""
        found = values.tags == Tag.TEXT
        if not found.any():
            return values
        places = []
        for at in values.values[found].astype(int).tolist():
            if texts[at] not in self._places:
                self._places[texts[at]] = len(self.texts)
                self.texts.append(texts[at])
            places.append(self._places[texts[at]])
        numbers = values.values.copy()
        numbers[found] = places
        return values._replace(values=numbers)


def _whole(parts: Sequence[SignalChanges]) -> SignalChanges:
    """The parts as one; repeated values are no changes."""
    times = np.concatenate([part.times for part in parts])
    values = np.concatenate([part.values for part in parts])
    tags = np.concatenate([part.tags for part in parts])
    bits = values.view(np.int64)
    kept = np.ones(len(times), bool)
    kept[1:] = (bits[1:] != bits[:-1]) | (tags[1:] != tags[:-1])
    kinds = frozenset[int]().union(*(part.kinds for part in parts))
    return SignalChanges(times[kept], values[kept], tags[kept], kinds)


def _series(values: SignalChanges, texts: Sequence[str]) -> Series:
    """As for the whole recording: a value that is ever a text has no statistics."""
    series = series_of(values.times, values.values, values.tags, texts)
    kinds = {Tag.BOOLEAN: SeriesKind.BOOLEAN, Tag.TEXT: SeriesKind.TEXT}
    return replace(series, kind=next((kinds[tag] for tag in kinds if tag in values.kinds), SeriesKind.NUMBER))


class _At:
    """The values that a rule reads for a subject at a time."""

    def __init__(self, values: Mapping[str, SignalChanges], texts: Sequence[str]) -> None:
        self._values = values
        self._texts = texts

    def at(self, time: int) -> dict[str, object]:
        """The known signals."""
        found: dict[str, object] = {}
        for name, each in self._values.items():
            place = int(np.searchsorted(each.times, time, "right")) - 1
            if place >= 0 and each.tags[place] in _KNOWN:
                kind = {Tag.BOOLEAN: SeriesKind.BOOLEAN, Tag.TEXT: SeriesKind.TEXT}.get(
                    Tag(each.tags[place]), SeriesKind.NUMBER
                )
                found[name] = Series(each.times, each.values, kind, self._texts).plain(float(each.values[place]))
        return found
