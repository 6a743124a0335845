"""The dataset: Parquet files that DuckDB, polars and pandas read without configuration.

    episodes/rule=NAME/part-0.parquet   a row for each episode, by recording and start; all rules have the same columns
    recordings.parquet                  a row for each recording
    rules.parquet                       for each recording and rule: how its evaluations went
    streams.parquet                     for each recording and stream: the quality of the data
    nearest.parquet                     for each recording and rule with a margin: its near misses
    errors.parquet                      what is wrong with recordings, and with rules over them

The rows have a defined order, so the same results give the same bytes, however they were computed.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from detector.mining.work import RecordingResult
from detector.results.episodes import EpisodeRow, merged_kind, table_of, value_kinds
from detector.results.nearest import nearest_by_rule

EPISODES = "episodes"
TABLES = ("recordings", "rules", "streams", "nearest", "errors")
_ROWS = 50_000
"""Of a row group."""


class MinedRecording(NamedTuple):
    """The result of one recording."""

    name: str
    content: str
    """Identifies the content; empty if it cannot be read."""
    parts: Callable[[], Sequence[RecordingResult]]
    """Reads the cached parts, each about other rules; called more than once."""


def write_dataset(
    folder: Path, recordings: Sequence[MinedRecording], rules: Sequence[str], *, with_clips: bool
) -> None:
    """Write all files, in order of the given recordings. Files of removed rules are deleted.

    `with_clips`: episodes have a column with the folders of their clips, relative to the dataset.

    Raises:
        OSError: a file cannot be written.
    """
    kinds: dict[str, str] = {}
    for recording in recordings:
        for part in recording.parts():
            for name, kind in value_kinds(part.episodes).items():
                kinds[name] = merged_kind(kinds.get(name, "null"), kind)
    new = folder / ".new"
    shutil.rmtree(new, ignore_errors=True)
    _write_episodes(new / EPISODES, recordings, rules, dict(sorted(kinds.items())), with_clips)
    for name, (columns, rows) in _tables(recordings).items():
        _write_table(new / f"{name}.parquet", columns, rows)
    # Remove all old episodes first, so that the folder never mixes two runs.
    shutil.rmtree(folder / EPISODES, ignore_errors=True)
    for path in sorted(new.iterdir()):
        path.replace(folder / path.name)
    new.rmdir()


def _write_episodes(
    folder: Path, recordings: Iterable[MinedRecording], rules: Sequence[str], kinds: dict[str, str], with_clips: bool
) -> None:
    import pyarrow.parquet as pq  # noqa: PLC0415  an extra

    schema = _table([], kinds, with_clips).schema
    with ExitStack() as stack:
        writers = {}
        for rule in rules:
            path = folder / f"rule={rule}" / "part-0.parquet"
            path.parent.mkdir(parents=True)
            writers[rule] = stack.enter_context(pq.ParquetWriter(path, schema, compression="zstd"))
        waiting: dict[str, list[tuple[EpisodeRow, Sequence[str]]]] = {rule: [] for rule in rules}
        for recording in recordings:
            for part in recording.parts():
                for episode in part.episodes:
                    if episode.rule in waiting:
                        episode.recording = recording.name
                        waiting[episode.rule].append((episode, part.clips.get(episode.episode, ())))
            for rule, rows in waiting.items():
                while len(rows) >= _ROWS:  # always this number, so that groups do not depend on the recordings
                    writers[rule].write_table(_table(rows[:_ROWS], kinds, with_clips))
                    del rows[:_ROWS]
        for rule, rows in waiting.items():
            if rows:
                writers[rule].write_table(_table(rows, kinds, with_clips))


def _table(rows: Sequence[tuple[EpisodeRow, Sequence[str]]], kinds: dict[str, str], with_clips: bool) -> Any:
    """The rows as a pyarrow.Table; the rule is the name of the folder."""
    import pyarrow as pa  # noqa: PLC0415

    table = table_of([episode for episode, _ in rows], kinds).drop_columns(["rule"])
    if with_clips:
        table = table.append_column("clips", pa.array([list(clips) for _, clips in rows], pa.list_(pa.string())))
    return table


def _write_table(path: Path, columns: dict[str, Any], rows: Sequence[tuple[object, ...]]) -> None:
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    arrays = [pa.array([row[at] for row in rows], kind) for at, kind in enumerate(columns.values())]
    pq.write_table(pa.table(arrays, names=[*columns]), path, compression="zstd")


def _tables(recordings: Iterable[MinedRecording]) -> dict[str, tuple[dict[str, Any], list[tuple[object, ...]]]]:
    """By file, its columns with their types, and its rows."""
    import pyarrow as pa  # noqa: PLC0415

    text, number, double, time = pa.string(), pa.int64(), pa.float64(), pa.timestamp("ns", tz="UTC")
    whole: list[tuple[object, ...]] = []
    counts: list[tuple[object, ...]] = []
    streams: list[tuple[object, ...]] = []
    nearest: list[tuple[object, ...]] = []
    errors: list[tuple[object, ...]] = []
    for recording in recordings:
        parts = recording.parts()
        name = recording.name
        whole.append(_recording_row(recording, parts))
        for part in parts:
            own = [episode.rule for episode in part.episodes]
            counts += [(name, c.rule, own.count(c.rule), c.evaluations, c.unknown, c.errors) for c in part.counts]
        streams += [(name, *row) for row in _stream_rows(parts)]
        near = nearest_by_rule(each for part in parts for each in part.nearest)
        nearest += [(name, each.rule, each.subject, each.time, each.margin) for each in near]
        flaws = {flaw for part in parts for flaw in part.flaws}
        errors += [(name, flaw.kind, flaw.rule, flaw.message) for flaw in sorted(flaws, key=_flaw_order)]
    return {
        "recordings": (
            {"recording": text, "content": text, "samples": number, "start_time": time, "end_time": time,
             "duration": double},
            whole,
        ),
        "rules": (
            {"recording": text, "rule": text, "episodes": number, "evaluations": number, "unknown": number,
             "errors": number},
            sorted(counts, key=lambda row: (str(row[0]), str(row[1]))),
        ),
        "streams": (
            {"recording": text, "stream": text, "key": text, "encoding": text, "samples": number, "keys": number,
             "rate": double, "gap": double, "gap_key": text, "gap_time": time, "unreadable": number,
             "last_unreadable": text, "unnamed": number},
            streams,
        ),
        "nearest": ({"recording": text, "rule": text, "subject": text, "time": time, "margin": double}, nearest),
        "errors": ({"recording": text, "kind": text, "rule": text, "message": text}, errors),
    }  # fmt: skip


def _recording_row(recording: MinedRecording, parts: Sequence[RecordingResult]) -> tuple[object, ...]:
    best = max(parts, key=lambda part: part.samples, default=None)
    if best is None or not best.samples:
        return recording.name, recording.content, 0, None, None, None
    seconds = (best.end - best.begin) / 1e9
    return recording.name, recording.content, best.samples, best.begin, best.end, seconds


def _stream_rows(parts: Sequence[RecordingResult]) -> Iterator[tuple[object, ...]]:
    """The stream statistics of all parts agree, except for unreadable messages: only rules that read these find
    them."""
    by_stream = [[part.streams[at] for part in parts if part.streams] for at in range(_streams(parts))]
    for of_one in by_stream:
        worst = max(of_one, key=lambda each: (each.unreadable, each.last_unreadable))
        yield (
            worst.stream, worst.key, worst.encoding, worst.samples, worst.keys, worst.rate, worst.gap, worst.gap_key,
            worst.gap_time, worst.unreadable, worst.last_unreadable or None, worst.unnamed,
        )  # fmt: skip


def _streams(parts: Sequence[RecordingResult]) -> int:
    return max((len(part.streams) for part in parts), default=0)


def _flaw_order(flaw: Any) -> tuple[str, str, str]:
    return flaw.kind, flaw.rule or "", flaw.message
