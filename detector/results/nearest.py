"""Near misses: for rules with a margin, the moments at which they came nearest to an episode without one."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from detector.results.episodes import EpisodeRow
from detector.results.series import SubjectTrace
from wayside.rules import CompiledRule
from wayside.times import format_time

MOST = 10
"""Maximum number listed per rule."""

_PROMINENCE = 1.0
"""Two moments count separately if the margin falls by this between them: by one unit of the scale."""


class NearMoment(NamedTuple):
    """One near miss."""

    recording: str
    rule: str
    subject: str
    time: int
    """Nanoseconds since the epoch."""
    margin: float
    """At most 0 if the condition did not hold; more if it held for too short a time. Finite."""


def nearest_moments(
    recording: str, rules: Mapping[str, CompiledRule], subjects: Iterable[SubjectTrace], episodes: Iterable[EpisodeRow]
) -> list[NearMoment]:
    """The nearest moments of each rule without an episode, those with the largest margin first."""
    spans: dict[tuple[str, str], list[tuple[int, int | None]]] = {}
    for episode in episodes:
        spans.setdefault((episode.rule, episode.subject), []).append((episode.onset_time, episode.end_time))
    found: list[NearMoment] = []
    for trace in subjects:
        rule = rules.get(trace.rule)
        if rule is not None and rule.has_margin and "margin" in trace.signals:
            series = trace.signals["margin"]
            times, values = series.times.tolist(), series.values.tolist()
            for time, margin in _peaks(times, values, spans.get((trace.rule, trace.subject), ())):
                if math.isfinite(margin):
                    found.append(NearMoment(recording, trace.rule, trace.subject, time, margin))
    return nearest_by_rule(found)


def nearest_by_rule(moments: Iterable[NearMoment]) -> list[NearMoment]:
    """The nearest of these moments by rule, those with the largest margin first."""
    by_rule: dict[str, list[NearMoment]] = {}
    for each in sorted(moments, key=lambda each: (each.rule, -each.margin, each.time, each.recording, each.subject)):
        by_rule.setdefault(each.rule, []).append(each)
    return [each for own in by_rule.values() for each in own[:MOST]]


def _peaks(
    times: Sequence[int], values: Sequence[float], spans: Sequence[tuple[int, int | None]]
) -> Iterator[tuple[int, float]]:
    """The maxima of the margin between episodes, unknowns and falls; not adjacent to an episode."""
    stretch: list[tuple[int, float]] = []
    after = False
    for time, value in zip(times, values, strict=True):
        inside = any(begin <= time and (end is None or time <= end) for begin, end in spans)
        if inside or value != value:  # noqa: PLR0124  NaN alone differs
            yield from _of_stretch(stretch, after, inside)
            stretch, after = [], inside
        else:
            stretch.append((time, value))
    yield from _of_stretch(stretch, after, False)


def _of_stretch(stretch: Sequence[tuple[int, float]], after: bool, before: bool) -> Iterator[tuple[int, float]]:
    """The peaks of values without a gap; `after` and `before`: an episode precedes or follows it."""
    if not stretch:
        return
    best = low = stretch[0]
    rising = not after
    for each in stretch:
        if rising:
            best = each if each[1] > best[1] else best
            if each[1] < best[1] - _PROMINENCE:
                yield best
                rising, low = False, each
        else:
            low = each if each[1] < low[1] else low
            if each[1] > low[1] + _PROMINENCE:
                rising, best = True, each
    if rising and not before:
        yield best


def write_moments(path: Path, moments: Sequence[NearMoment]) -> None:
    """Write them as CSV, with times as RFC 3339."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(NearMoment._fields)
        writer.writerows([each._replace(time=format_time(each.time)) for each in moments])  # type: ignore[arg-type]


def show_moments(console: Console, moments: Sequence[NearMoment]) -> None:
    """Print them as a table; the recordings have a column if there are several."""
    several = len({each.recording for each in moments}) > 1
    table = Table(
        box=None, header_style="bold", pad_edge=False, title="nearest without an episode", title_justify="left"
    )
    for name in ("rule", *(["recording"] if several else []), "subject", "time"):
        table.add_column(name, overflow="fold")
    table.add_column("margin", justify="right")
    for each in moments:
        where = [each.recording] if several else []
        table.add_row(each.rule, *where, each.subject, format_time(each.time), f"{each.margin:.3g}")
    console.print(table)
