"""Writes the results of a replay into its folder."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from detector.engine.samples.sample import Arrival
from detector.replay.replaying import ReplayResult
from detector.results.episodes import write_csv, write_parquet
from detector.results.kinds import ResultKind, check_package
from detector.results.nearest import NearMoment, nearest_by_rule, show_moments
from detector.results.nearest import write_moments as write_nearest
from detector.results.quality import Arrivals
from detector.results.result import Result, result_of
from detector.results.tracing import Tracer

_NEEDED = {ResultKind.REPORT: "bokeh", ResultKind.MCAP: "foxglove", ResultKind.EPISODES: "pyarrow"}


def check_installed(kinds: Iterable[ResultKind]) -> None:
    """Raises MissingExtraError if a package of the extra is missing: before hours of replay, not after them."""
    for kind in sorted(kinds):
        check_package(_NEEDED[kind], f"--results {kind}")


class RecordingTrace(NamedTuple):
    """The observers of the replay of one recording."""

    tracer: Tracer
    arrivals: Arrivals


class ResultCollector:
    """Observes the replay of several recordings, one after another."""

    def __init__(self) -> None:
        self._traces: dict[str, RecordingTrace] = {}

    def watch(self, name: str) -> RecordingTrace:
        """The observers of the recording of that name, which comes next."""
        trace = self._traces[name] = RecordingTrace(Tracer(), Arrivals())
        return trace

    def batches(self, batches: Iterable[Sequence[Arrival]]) -> Iterator[Sequence[Arrival]]:
        """The batches of the current recording, unchanged."""
        return [*self._traces.values()][-1].arrivals.watch_batches(batches)

    def results(self, outcomes: Mapping[str, ReplayResult]) -> list[Result]:
        """The result of each recording."""
        return [result_of(name, outcome, *self._traces[name]) for name, outcome in outcomes.items()]


def write_results(folder: Path, results: Sequence[Result], kinds: frozenset[ResultKind]) -> list[Path]:
    """Write them; returns the files. Of several recordings, each has separate files, but all share one table."""
    written: list[Path] = []

    def path(name: str) -> Path:
        written.append(folder / name)
        return written[-1]

    episodes = [episode for result in results for episode in result.episodes]
    if ResultKind.EPISODES in kinds:
        write_csv(path("episodes.csv"), episodes)
        write_parquet(path("episodes.parquet"), episodes)
        if near := _nearest(results):
            write_nearest(path("nearest.csv"), near)
    for number, result in enumerate(results, start=1):
        suffix = f"-{number}" if len(results) > 1 else ""
        if ResultKind.MCAP in kinds:
            from detector.results.foxglove_file import layout_of, write_mcap  # noqa: PLC0415  an extra

            write_mcap(path(f"results{suffix}.mcap"), result)
            path(f"layout{suffix}.json").write_text(layout_of(result) + "\n", encoding="utf-8")
        if ResultKind.REPORT in kinds:
            from detector.results.report import write_report  # noqa: PLC0415

            write_report(path(f"report{suffix}.html"), result)
    return written


def show_summary(console: Console, results: Sequence[Result]) -> None:
    """Print a table of the rules over all recordings."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("rule", overflow="fold")
    for name in ("episodes", "subjects", "open", "in all", "longest", "unknown", "errors"):
        table.add_column(name, justify="right")
    episodes = [episode for result in results for episode in result.episodes]
    for rule in sorted({rule for result in results for rule in result.rules}):
        own = [episode for episode in episodes if episode.rule == rule]
        lasting = [episode.duration for episode in own if episode.duration is not None]
        counts = [result.counts.get(rule, (0, 0, 0)) for result in results]
        evaluations = sum(each[0] for each in counts)
        unknown = sum(each[1] for each in counts)
        table.add_row(
            rule,
            str(len(own)),
            str(len({(episode.recording, episode.subject) for episode in own})),
            str(sum(episode.end_time is None for episode in own)),
            f"{sum(lasting):.1f} s",
            f"{max(lasting, default=0):.1f} s",
            f"{unknown} of {evaluations}" if unknown else "0",
            str(sum(each[2] for each in counts)),
        )
    console.print(table)
    if near := _nearest(results):
        show_moments(console, near)


def _nearest(results: Sequence[Result]) -> list[NearMoment]:
    """The near misses of all recordings, rule by rule."""
    return nearest_by_rule(each for result in results for each in result.nearest)
