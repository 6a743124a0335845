"""A summary of a dataset: episodes by rule and by recording, the rarest ones, and the nearest moments without one."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from detector.mining.dataset import EPISODES
from detector.results.nearest import NearMoment, nearest_by_rule, show_moments

_RECORDINGS = 10
"""Maximum number of listed recordings."""
_RARE = 5
"""Maximum number of listed rare episodes."""


class RuleSummary(NamedTuple):
    """One rule over all recordings."""

    rule: str
    episodes: int
    recordings: int
    """Number of recordings with an episode."""
    total: float
    longest: float
    """Seconds, of ended episodes."""
    evaluations: int
    unknown: int
    errors: int


class RareEpisode(NamedTuple):
    """An episode of a rule with few episodes."""

    rule: str
    recording: str
    subject: str
    start: datetime


@dataclass(frozen=True)
class Summary:
    """The whole summary."""

    rules: list[RuleSummary]
    """The rarest first."""
    recordings: list[tuple[str, dict[str, int]]]
    """Their episodes by rule; the recordings with most episodes first. Recordings without episodes are left out."""
    rarest: list[RareEpisode]
    nearest: list[NearMoment]
    """The near misses of all recordings, by rule."""
    errors: list[dict[str, Any]]
    """The rows of errors.parquet."""
    recordings_read: int
    samples: int
    seconds: float
    """Duration of all recordings together."""


def summary_of(folder: Path) -> Summary:
    """Read a dataset. Raises OSError if it is incomplete."""
    import pyarrow.parquet as pq  # noqa: PLC0415  an extra

    by_recording: dict[str, dict[str, int]] = {}
    found = []
    counts: dict[str, list[int]] = {}
    for row in pq.read_table(folder / "rules.parquet").to_pylist():
        own = counts.setdefault(row["rule"], [0, 0, 0])
        for at, name in enumerate(("evaluations", "unknown", "errors")):
            own[at] += row[name]
        if row["episodes"]:
            by_recording.setdefault(row["recording"], {})[row["rule"]] = row["episodes"]
    for path in sorted((folder / EPISODES).iterdir()):
        rule = path.name.partition("=")[2]
        table = pq.ParquetDataset(path, partitioning=None).read(["recording", "duration"])
        lasting = [each for each in table.column("duration").to_pylist() if each is not None]
        recordings = len(table.column("recording").unique())
        evaluations = counts.get(rule, [0, 0, 0])
        found.append(RuleSummary(rule, len(table), recordings, sum(lasting), max(lasting, default=0.0), *evaluations))
    rules = sorted(found, key=lambda each: (each.episodes, each.rule))
    whole = pq.read_table(folder / "recordings.parquet").to_pylist()
    return Summary(
        rules,
        sorted(by_recording.items(), key=lambda each: (-sum(each[1].values()), each[0])),
        _rarest(folder, rules),
        _nearest(folder),
        pq.read_table(folder / "errors.parquet").to_pylist(),
        sum(row["samples"] > 0 for row in whole),
        sum(row["samples"] for row in whole),
        sum(row["duration"] or 0.0 for row in whole),
    )


def _rarest(folder: Path, rules: list[RuleSummary]) -> list[RareEpisode]:
    """The first episodes of the rules that have the fewest."""
    import pyarrow.parquet as pq  # noqa: PLC0415

    found: list[RareEpisode] = []
    for rule in rules:
        if rule.episodes and len(found) < _RARE:
            file = folder / EPISODES / f"rule={rule.rule}" / "part-0.parquet"
            with pq.ParquetFile(file) as parquet:
                batch = next(parquet.iter_batches(_RARE - len(found), columns=["recording", "subject", "start_time"]))
            for row in batch.to_pylist():
                found.append(RareEpisode(rule.rule, row["recording"], row["subject"], row["start_time"]))
    return found


def _nearest(folder: Path) -> list[NearMoment]:
    """The near misses of all recordings, by rule."""
    import pyarrow.parquet as pq  # noqa: PLC0415

    table = pq.read_table(folder / "nearest.parquet")
    table = table.set_column(table.schema.get_field_index("time"), "time", table.column("time").cast("int64"))
    return nearest_by_rule(NearMoment(**row) for row in table.to_pylist())


def show(console: Console, summary: Summary) -> None:
    """Print it."""
    table = _table("rule", "episodes", "recordings", "in all", "longest", "unknown", "errors")
    for rule in summary.rules:
        unknown = f"{rule.unknown / rule.evaluations:.1%}" if rule.unknown else "0"
        total, longest = f"{rule.total:.1f} s", f"{rule.longest:.1f} s"
        table.add_row(rule.rule, str(rule.episodes), str(rule.recordings), total, longest, unknown, str(rule.errors))
    console.print(table)
    if summary.recordings:
        table = _table("recording", "episodes", justify_last="left")
        for name, by_rule in summary.recordings[:_RECORDINGS]:
            parts = ", ".join(f"{rule} {count}" for rule, count in sorted(by_rule.items()))
            table.add_row(name, f"{sum(by_rule.values())}: {parts}")
        console.print()
        console.print(table)
        if (more := len(summary.recordings) - _RECORDINGS) > 0:
            console.print(f"and {more} more recordings with episodes: see rules.parquet")
    if summary.rarest:
        console.print()
        console.print("the rarest:")
        for each in summary.rarest:
            start = each.start.isoformat(sep=" ", timespec="milliseconds")
            console.print(f"  {each.rule}: {each.subject} in {each.recording} at {start}", highlight=False)
    if summary.nearest:
        console.print()
        show_moments(console, summary.nearest)


def _table(*names: str, justify_last: Any = "right") -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column(names[0], overflow="fold")
    for name in names[1:-1]:
        table.add_column(name, justify="right")
    table.add_column(names[-1], justify=justify_last, overflow="fold")
    return table
