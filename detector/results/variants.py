"""The comparison of variants of rules with the rules as written: a table, and variants.json.

For each subject, two episodes match if they overlap in time. Each is matched with at most one: in order of their
starts, an episode of the first rule is matched with the episode of the second rule that it shares most time with. An
episode that is still open ends with the recording.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from detector.engine.episodes.events import Event
from detector.replay.replaying import ReplayResult
from detector.replay.variants import Variant
from wayside.times import format_time


@dataclass(frozen=True, slots=True, order=True)
class EpisodeTimes:
    """An episode's time for one subject; nanoseconds since the epoch."""

    start: int
    end: int
    subject: str
    open: bool = False
    """It was still open at the end of the recording."""
    recording: str | None = None
    """The recording of the episode, if there are several."""

    def shared(self, other: EpisodeTimes) -> int:
        """How long both last, in nanoseconds; negative if they are apart."""
        return min(self.end, other.end) - max(self.start, other.start)

    def to_json(self) -> dict[str, Any]:
        """Subject, start and end as text, and the recording if there are several."""
        times = {"startTime": format_time(self.start), "endTime": None if self.open else format_time(self.end)}
        return {"subject": self.subject, **times, **self.origin}

    @property
    def origin(self) -> dict[str, str]:
        """The recording, for JSON."""
        return {} if self.recording is None else {"recording": self.recording}


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of the comparison of two rules."""

    first: str
    second: str
    both: tuple[tuple[EpisodeTimes, EpisodeTimes], ...]
    only_first: tuple[EpisodeTimes, ...]
    only_second: tuple[EpisodeTimes, ...]

    @property
    def start_differences(self) -> list[float]:
        """Second minus first, in seconds: positive if the second rule was later."""
        return [(second.start - first.start) / 1e9 for first, second in self.both]

    @property
    def agreement(self) -> float | None:
        """The time in which both had an episode of a subject, by that in which either had; None without episodes."""
        shared = sum(first.shared(second) for first, second in self.both)
        spans = [*self.only_first, *self.only_second, *(span for pair in self.both for span in pair)]
        either = sum(span.end - span.start for span in spans) - shared
        return shared / either if either else None

    def to_json(self) -> dict[str, Any]:
        """Everything, for `variants.json`."""
        return {
            "rules": [self.first, self.second],
            "both": [
                {
                    "subject": first.subject,
                    **first.origin,
                    "first": first.to_json(),
                    "second": second.to_json(),
                    "startDifference": (second.start - first.start) / 1e9,
                    "endDifference": None if first.open or second.open else (second.end - first.end) / 1e9,
                }
                for first, second in self.both
            ],
            "onlyFirst": [span.to_json() for span in self.only_first],
            "onlySecond": [span.to_json() for span in self.only_second],
            "agreement": self.agreement,
        }


def compare(events: Iterable[Event], first: str, second: str, end: int) -> Comparison:
    """Compare the episodes of two rules; the recording ends at `end`, in nanoseconds since the epoch."""
    of_rule: dict[str, list[EpisodeTimes]] = {first: [], second: []}
    open_spans: dict[str, Event] = {}
    for event in events:
        episode = event.episode
        if episode.rule not in of_rule:
            continue
        if event.end_time is None:
            open_spans[episode.id] = event
        else:
            open_spans.pop(episode.id, None)
            span = EpisodeTimes(episode.start_time, event.end_time, episode.subject, recording=event.recording)
            of_rule[episode.rule].append(span)
    for event in open_spans.values():
        episode = event.episode
        last = max(end, episode.start_time)
        span = EpisodeTimes(episode.start_time, last, episode.subject, open=True, recording=event.recording)
        of_rule[episode.rule].append(span)
    return _matched(first, second, sorted(of_rule[first]), sorted(of_rule[second]))


def combined(comparisons: Sequence[Comparison]) -> Comparison:
    """The comparisons of several recordings, merged; there is at least one."""
    return Comparison(
        comparisons[0].first,
        comparisons[0].second,
        tuple(pair for each in comparisons for pair in each.both),
        tuple(span for each in comparisons for span in each.only_first),
        tuple(span for each in comparisons for span in each.only_second),
    )


def _matched(first: str, second: str, spans: Sequence[EpisodeTimes], others: Sequence[EpisodeTimes]) -> Comparison:
    left: dict[str, list[EpisodeTimes]] = {}
    for other in others:
        left.setdefault(other.subject, []).append(other)
    both: list[tuple[EpisodeTimes, EpisodeTimes]] = []
    only: list[EpisodeTimes] = []
    for span in spans:
        candidates = [other for other in left.get(span.subject, ()) if span.shared(other) >= 0]
        if not candidates:
            only.append(span)
            continue
        best = max(candidates, key=span.shared)
        left[span.subject].remove(best)
        both.append((span, best))
    rest = sorted(other for of_subject in left.values() for other in of_subject)
    return Comparison(first, second, tuple(both), tuple(only), tuple(rest))


def comparisons(outcomes: Sequence[ReplayResult], variants: Sequence[Variant]) -> list[Comparison]:
    """Each variant with its rule as written, over all recordings."""
    return [
        combined([compare(outcome.events, each.of, each.rule.name, outcome.end) for outcome in outcomes])
        for each in variants
    ]


def write_variants(path: Path, variants: Sequence[Variant], found: Sequence[Comparison]) -> None:
    """Write which episodes each variant shares with its rule, adds and loses."""
    documents = [
        {"rule": each.of, "variant": each.label, **comparison.to_json()}
        for each, comparison in zip(variants, found, strict=True)
    ]
    path.write_text(json.dumps(documents, indent=1) + "\n", encoding="utf-8")


def show_variants(console: Console, variants: Sequence[Variant], found: Sequence[Comparison]) -> None:
    """Print a table: the rule as written first, then its variants."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for name in ("rule", "variant"):
        table.add_column(name, overflow="fold")
    for name in ("episodes", "same", "gained", "lost", "start", "agreement"):
        table.add_column(name, justify="right")
    before = None
    for each, comparison in zip(variants, found, strict=True):
        if each.of != before:
            before = each.of
            table.add_row(escape(each.of), "as written", str(len(comparison.both) + len(comparison.only_first)))
        later = comparison.start_differences
        agreement = comparison.agreement
        table.add_row(
            "",
            escape(each.label),
            str(len(comparison.both) + len(comparison.only_second)),
            str(len(comparison.both)),
            f"+{len(comparison.only_second)}",
            f"-{len(comparison.only_first)}",
            f"{statistics.median(later):+.2f} s" if later else "",
            "" if agreement is None else f"{agreement:.1%}",
        )
    console.print(table, highlight=False)
