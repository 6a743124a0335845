"""Episodes as a table: one row each, with its times, its values and the statistics of its signals."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from detector.engine.episodes.events import Event
from detector.results.series import Series, SeriesKind, SubjectTrace, Trace
from wayside.times import format_time

Plain = float | bool | str | None

FIXED = (
    "recording", "rule", "subject", "subjects", "element", "episode", "onset_time", "start_time", "end_time",
    "duration", "reason", "dry_run",
)  # fmt: skip
TIMES = ("onset_time", "start_time", "end_time")
_KINDS: Mapping[type, str] = {bool: "boolean", float: "number", type(None): "null"}
"""Kinds of columns, by the type of a value; all others are text."""


@dataclass(slots=True)
class EpisodeRow:
    """One row."""

    recording: str
    rule: str
    subject: str
    subjects: tuple[str, ...]
    element: str | None
    episode: str
    onset_time: int
    start_time: int
    end_time: int | None
    """None: it was open at the end of the recording. Nanoseconds since the epoch, like all times."""
    reason: str | None
    dry_run: bool
    values: dict[str, Plain] = field(default_factory=dict)
    """By `<signal>.start`, `.end`, `.min`, `.max` and `.mean`: the known ones."""

    @property
    def duration(self) -> float | None:
        """Seconds."""
        return None if self.end_time is None else (self.end_time - self.start_time) / 1e9


def episodes_of(recording: str, events: Iterable[Event], trace: Trace) -> list[EpisodeRow]:
    """The episodes of a recording, in order of their starts.

    Minimum and maximum cover all ticks of the episode; the mean is weighted by time. For an open episode they cover the
    time up to the end of the recording.
    """
    traces = {(each.rule, each.subject): each for each in trace.subjects}
    found: dict[str, EpisodeRow] = {}
    for event in events:
        episode = found.get(event.episode.id)
        if episode is None:
            episode = found[event.episode.id] = _episode(recording, event)
        if event.started:
            episode.values |= {f"{name}.start": value for name, value in flat(event.values)}
        else:
            episode.end_time, episode.reason = event.end_time, str(event.reason)
            episode.values |= {f"{name}.end": value for name, value in flat(event.values)}
    for episode in found.values():
        subject = traces.get((episode.rule, episode.subject))
        if subject is not None:
            episode.values |= _statistics(subject, episode, trace.end)
    return sorted(found.values(), key=lambda each: (each.start_time, each.rule, each.subject))


def _episode(recording: str, event: Event) -> EpisodeRow:
    episode = event.episode
    return EpisodeRow(
        recording, episode.rule, episode.subject, episode.clients, episode.element, episode.id, episode.onset_time,
        episode.start_time, None, None, event.dry_run,
    )  # fmt: skip


def flat(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Plain]]:
    """The values of an event by their names in expressions; lists as JSON."""
    for name, value in values.items():
        if name == "client" and above:
            continue
        if isinstance(value, Mapping):
            yield from flat(value, f"{above}{name}.")
        elif isinstance(value, list):
            yield above + name, json.dumps(value)
        elif isinstance(value, bool | str) or value is None:
            yield above + name, value
        else:
            yield above + name, float(value)


def _statistics(trace: SubjectTrace, episode: EpisodeRow, last: int) -> dict[str, Plain]:
    end = last if episode.end_time is None else episode.end_time
    found: dict[str, Plain] = {}
    for name, series in trace.signals.items():
        if series.kind is not SeriesKind.NUMBER:
            continue
        times, values = within(series, episode.start_time, end)
        known = ~np.isnan(values)
        if not known.any():
            continue
        found[f"{name}.min"], found[f"{name}.max"] = float(values[known].min()), float(values[known].max())
        lasting = np.diff(times, append=end).astype(float)
        weights = lasting[known]
        found[f"{name}.mean"] = (
            float(np.average(values[known], weights=weights)) if weights.sum() else float(values[known][0])
        )
    return found


def within(series: Series, begin: int, end: int) -> tuple[Any, Any]:
    """Times and values of a series between two times, both included; the first is the value at the beginning."""
    low, high = np.searchsorted(series.times, [begin, end], "right")
    times = np.concatenate(([begin], series.times[low:high]))
    values = np.concatenate((series.at(np.array([begin])), series.values[low:high]))
    return times, values


def columns_of(episodes: Iterable[EpisodeRow]) -> list[str]:
    """The names of the values, in order."""
    return sorted({name for each in episodes for name in each.values})


def write_csv(path: Path, episodes: Sequence[EpisodeRow]) -> None:
    """Write the table as CSV: times as RFC 3339, unknown values empty."""
    names = columns_of(episodes)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*FIXED, *names])
        for each in episodes:
            times = [None if time is None else format_time(time) for time in _times(each)]
            row = [
                each.recording, each.rule, each.subject, "+".join(each.subjects), each.element, each.episode, *times,
                each.duration, each.reason, _text(each.dry_run), *(_text(each.values.get(name)) for name in names),
            ]  # fmt: skip
            writer.writerow(["" if value is None else value for value in row])


def _times(each: EpisodeRow) -> tuple[int | None, ...]:
    return each.onset_time, each.start_time, each.end_time


def _text(value: Plain) -> Plain:
    """Booleans in the form that CSV readers expect; numbers unchanged, with all digits."""
    return str(value).lower() if isinstance(value, bool) else value


def write_parquet(path: Path, episodes: Sequence[EpisodeRow]) -> None:
    """Write the table as Parquet: times as timestamps in UTC with nanoseconds, subjects as a list."""
    import pyarrow.parquet as pq  # noqa: PLC0415  an extra

    pq.write_table(table_of(episodes, value_kinds(episodes)), path, compression="zstd")


def value_kinds(episodes: Iterable[EpisodeRow]) -> dict[str, str]:
    """By the names of the values, sorted: `number`, `boolean`, `text` (also for a mixture), or `null`."""
    found: dict[str, str] = {}
    for each in episodes:
        for name, value in each.values.items():
            found[name] = merged_kind(found.get(name, "null"), _KINDS.get(type(value), "text"))
    return dict(sorted(found.items()))


def merged_kind(one: str, other: str) -> str:
    """The kind of a column with values of both kinds."""
    if "null" in (one, other):
        return one if other == "null" else other
    return one if one == other else "text"


def table_of(episodes: Sequence[EpisodeRow], kinds: Mapping[str, str]) -> Any:
    """The episodes as a pyarrow.Table, with a column for each value with a kind."""
    import pyarrow as pa  # noqa: PLC0415

    text, time = pa.string(), pa.timestamp("ns", tz="UTC")
    types = {
        "recording": text, "rule": text, "subject": text, "subjects": pa.list_(text), "element": text,
        "episode": text, **dict.fromkeys(TIMES, time), "duration": pa.float64(), "reason": text, "dry_run": pa.bool_(),
    }  # fmt: skip
    columns = {name: pa.array([_cell(each, name) for each in episodes], types[name]) for name in FIXED}
    of_kind = {"boolean": pa.bool_(), "number": pa.float64(), "null": pa.float64(), "text": text}
    for name, kind in kinds.items():
        values = [each.values.get(name) for each in episodes]
        if kind == "text":
            values = [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
        columns[name] = pa.array(values, of_kind[kind])
    return pa.table(columns)


def _cell(each: EpisodeRow, name: str) -> Any:
    value = getattr(each, name)
    return list(value) if name == "subjects" else value
