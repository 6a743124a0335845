"""Losses and unusable data: logged on first occurrence, then at most once a minute, and in total at the end.

Every kind of loss is counted where it occurs, with the reason of the last one. This module only reads the counters.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass

from detector.engine.counters import OLD, RuleCounters
from detector.engine.engine import Engine
from detector.engine.samples.intake import Intake
from detector.engine.timing.data import DataTimeline
from detector.findings.checks import (
    DIVERGING_STAMPS,
    OLD_SAMPLES,
    STALE_BETWEEN_SAMPLES,
    STREAM_WITHOUT_STAMPS,
    ZERO_STAMPS,
)
from detector.streams.loss_counter import LossCounter
from wayside.api.detector import DetectorSpec
from wayside.findings import Finding
from wayside.rules import PairSubject

_log = logging.getLogger(__name__)

_APART = 1_000_000_000
"""Nanoseconds: streams whose delays differ by more than this have diverging stamps."""

_EVERY = 60.0
"""Seconds between two log lines about the same kind of loss: bad input may arrive a thousand times a second."""


@dataclass(frozen=True, slots=True)
class Loss:
    """One kind of loss."""

    what: str
    count: int
    last: str = ""
    """The reason of the last one, if known."""
    _: KW_ONLY
    cause: str
    """One word, for metrics: letters and underscores."""
    stream: str = ""
    """The stream, or the source of streams."""
    rule: str = ""


class Losses:
    """Logs the increases of the counters of an engine and its intake."""

    def __init__(
        self, engine: Engine, intake: Intake | None = None, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        """`intake`: None in a replay, which has none; `monotonic` returns seconds."""
        self._engine = engine
        self._intake = intake
        self._monotonic = monotonic
        self._watched: list[Callable[[], Iterable[Loss]]] = []
        self._logged: dict[str, tuple[int, float]] = {}

    def watch(self, losses: Callable[[], Iterable[Loss]]) -> None:
        """Also report these losses."""
        self._watched.append(losses)

    def log_new(self) -> None:
        """Log each kind of loss that has increased, unless it was logged within the last minute."""
        now = self._monotonic()
        for loss in self.all():
            logged, since = self._logged.get(loss.what, (0, -math.inf))
            if loss.count > logged and now - since >= _EVERY:
                self._logged[loss.what] = loss.count, now
                _log.warning("%s", _line(loss, loss.count - logged))
        for what, finding in self._apart():
            if what not in self._logged:
                self._logged[what] = 1, now
                _log.warning("%s", finding)

    def sum_up(self) -> None:
        """Log the number of samples, all losses since the start, and a summary of the evaluations."""
        counters, buffer = self._engine.counters, self._engine.buffer
        _log.info("%d samples received, %d bytes buffered", sum(counters.samples.values()), buffer.bytes)
        for line in (*self.report(), *self.doubts()):
            _log.warning("in total, %s", line)

    def report(self) -> Iterator[str]:
        """All losses since the start, and where values were unknown, since a misspelt field causes that."""
        for loss in self.all():
            if loss.count:
                yield _line(loss, loss.count)
        for name, rule in self._engine.counters.rules.items():
            if rule.unknowns:
                often = "; ".join(_often(rule, in_pairs=self._in_pairs(name)))
                of_rule = f"{rule.unknowns} unknown values in {rule.evaluations} evaluations of EventRule {name}"
                yield f"{of_rule}: {often}" if often else of_rule

    def doubts(self) -> Iterator[Finding]:
        """Streams whose stamps do not match the clock; with measured ages, also rules that use or lack old samples."""
        yield from (finding for _, finding in self._apart())
        spec = self._engine.detector.spec
        for name, rule in self._engine.counters.rules.items():
            for stream_name, use in {} if rule.ages is None else rule.ages.uses.items():
                stream, period = spec.stream(stream_name), use.period
                limit = None if stream is None else spec.stale_after_ns(stream)
                if limit is None or period is None:
                    continue  # it never becomes stale: the last sample stays valid
                every = f"every {period / 1e9:.2g} s"
                if period > limit:
                    yield Finding(
                        STALE_BETWEEN_SAMPLES.name,
                        f"samples of stream {stream_name} arrive {every} and go stale after {limit / 1e9:g} s, so "
                        f"EventRule {name} has unknown values in between; raise streams[{stream_name}].staleAfter",
                        name,
                    )
                elif use.old:
                    old = f"{use.old} of the {use.count} samples it used were older than {OLD * period / 1e9:.2g} s"
                    yield Finding(
                        OLD_SAMPLES.name,
                        f"EventRule {name} used old samples of stream {stream_name}: they arrive {every}, but "
                        f"{old}. The last sample of a silent client stays valid until staleAfter: lower "
                        f"streams[{stream_name}].staleAfter"
                        + (", or maxAge of the position" if self._in_pairs(name) else ""),
                        name,
                    )

    def _in_pairs(self, rule: str) -> bool:
        """Whether the current rule is about pairs, whose positions have a separate limit."""
        run = self._engine.rules.get(rule)
        return run is not None and isinstance(run.rule.subject, PairSubject)

    def _apart(self) -> Iterator[tuple[str, Finding]]:
        """With clock Data, the streams whose stamps diverge from the others': a key and a finding for each."""
        counters = self._engine.counters
        all_unstamped = counters.delays.keys() <= counters.unstamped.keys()
        right = _right(counters.delays)
        for name in sorted({*counters.delays, *counters.zeros}):
            remedy = f"give streams[{name}].stamp, e.g. msg.time or sample.received, or write clock: Wall"
            if zeros := counters.zeros[name]:
                what = f"{zeros} samples of stream {name} have no time: their stamps are 0"
                yield f"zero {name}", Finding(ZERO_STAMPS.name, f"{what}; set the stamps in the sender, {remedy}")
            if (unstamped := counters.unstamped[name]) and not all_unstamped:
                what = f"{unstamped} samples of stream {name} have no stamp, unlike those of other streams"
                counted = f"{what}: with clock Data their receive time is used; {remedy}"
                yield f"unstamped {name}", Finding(STREAM_WITHOUT_STAMPS.name, counted)
            behind = counters.delays.get(name, right[1]) - right[1]
            if behind < -_APART:
                what = (
                    f"the stamps of stream {name} are {-counters.delays[name] / 1e9:.1f} s ahead of the receive times"
                )
                late = "with clock Data this makes the samples of other streams late; synchronize the sender's clock"
                yield f"ahead {name}", Finding(DIVERGING_STAMPS.name, f"{what}: {late}, {remedy}")
            elif behind > _APART:
                what = (
                    f"the stamps of stream {name} are {behind / 1e9:.1f} s further behind the receive times than those"
                )
                late = "with clock Data this makes its samples late; synchronize the sender's clock"
                yield f"behind {name}", Finding(DIVERGING_STAMPS.name, f"{what} of stream {right[0]}: {late}, {remedy}")

    def all(self) -> Iterator[Loss]:
        """Every kind of loss, including those with count 0."""
        counters, timeline = self._engine.counters, self._engine.timeline
        for losses in self._watched:
            yield from losses()
        if self._intake is not None:
            full = "samples dropped because the intake queue is full: more arrive than are evaluated"
            yield Loss(full, self._intake.dropped, cause="intake_full")
        pushed_out = "samples evicted from the buffer early because it is too small"
        yield Loss(pushed_out, self._engine.buffer.evicted, cause="evicted")
        if isinstance(timeline, DataTimeline):
            ahead, late = timeline.dropped_ahead, timeline.dropped_late
            yield Loss(
                "samples dropped because their stamps are ahead of the rest", ahead, timeline.last, cause="ahead"
            )
            yield Loss("samples dropped because their stamps are too old", late, timeline.last, cause="late")
            yield Loss(
                "samples dropped because too many wait for their time", timeline.dropped_full, cause="waiting_full"
            )
        too_late = "samples too late for the window of an action: raise lateness"
        yield Loss(too_late, self._engine.consequences.too_late, cause="window_late")
        for name, count in counters.undecodable.items():
            last = counters.last_undecodable.get(name, "")
            unread = f"times a sample of stream {name} could not be read"
            yield Loss(unread, count, last, cause="undecodable", stream=name)
        spec = self._engine.detector.spec
        for name, count in counters.unnamed.items():
            unnamed = f"{_samples(spec, name)} of stream {name} dropped because neither key nor message names a client"
            yield Loss(unnamed, count, counters.last_unnamed.get(name, ""), cause="unnamed", stream=name)
        for name, count in counters.crowded.items():
            crowded = f"{_samples(spec, name)} of stream {name} dropped because too many clients are known"
            yield Loss(crowded, count, cause="crowded", stream=name)
        for name, rule in counters.rules.items():
            yield Loss(f"evaluation errors in EventRule {name}", rule.errors, rule.last_error, cause="error", rule=name)
            misplaced = f"times a sample had no position for EventRule {name}"
            yield Loss(misplaced, rule.misplaced, rule.last_misplaced, cause="misplaced", rule=name)
            crowded = f"evaluations of pairs skipped for EventRule {name} because more than maxPairs are near"
            yield Loss(crowded, rule.crowded_pairs, cause="crowded_pairs", rule=name)
            kept = f"times a followed parameter kept its last value in EventRule {name}"
            yield Loss(kept, rule.unfollowed, rule.last_unfollowed, cause="unfollowed", rule=name)
            slow = f"evaluations of EventRule {name} skipped because the machine is too slow"
            yield Loss(slow, rule.skipped, cause="skipped", rule=name)
            often = f"episodes of EventRule {name} suppressed beyond maxEpisodesPerHour"
            yield Loss(often, rule.suppressed, cause="suppressed", rule=name)


def of_streams(loss_counter: LossCounter) -> Iterator[Loss]:
    """The losses before the detector, and those of sources."""
    for entry in loss_counter.entries():
        yield Loss(entry.text, entry.count, entry.last, cause=entry.cause.name.lower(), stream=entry.name)


def _line(loss: Loss, count: int) -> str:
    what = loss.what.removeprefix("times ")
    counted = f"{count} {loss.what}" if what == loss.what else f"{_times(count)} {what}"
    return counted + (f"; the last: {loss.last}" if loss.last else "")


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _often(rule: RuleCounters, *, in_pairs: bool) -> Iterator[str]:
    """The most frequent reasons for unknown values."""
    unexplained = rule.unknowns - rule.absences.total()
    if unexplained:
        limit = " (a position is old after its maxAge)" if in_pairs else ""
        yield f"{_times(unexplained)} no sample or an old one{limit}"
    for what, count in rule.absences.most_common(3):
        yield f"{_times(count)} {what}"


def _right(delays: Mapping[str, int]) -> tuple[str, int]:
    """The stream with the reference stamps, and its delay in nanoseconds.

    No stamp can be later than its receipt, so the smallest delay is right; if all are later, the nearest one.
    """
    ahead = {name: -delay for name, delay in delays.items() if delay < -_APART}
    nearest = {name: delay for name, delay in delays.items() if name not in ahead} or ahead
    name = min(nearest, key=nearest.__getitem__, default="")
    return name, delays.get(name, 0)


def _samples(spec: DetectorSpec, stream: str) -> str:
    """A description of the stream's samples."""
    found = spec.stream(stream)
    return "samples" if found is None or found.items is None else "items"
