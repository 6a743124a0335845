"""The implementation of `detector mine`: many recordings in, one dataset out."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from detector.assembly import lasting_problems
from detector.mining.mining import MiningRun, WorkShare, run_mining
from detector.mining.report import REPORT, write_mining_report
from detector.mining.sources import sampled, sources_of
from detector.mining.summary import Summary, show, summary_of
from detector.mining.workers import LocalWorkers, Workers
from detector.resources.files import load_rules
from detector.results.kinds import check_package
from wayside.process.commandline import refuse, table_console

_ERRORS = 20
"""Maximum number of errors that are printed."""
_NAMES = 8
"""Maximum number of rules that are named."""


def mine_recordings(
    given: Sequence[str],
    output: Path,
    detector: Path,
    rules: Sequence[Path],
    *,
    processes: int | None = None,
    dask: str | None = None,
    record: bool = False,
    sample: int | None = None,
    limit: int | None = None,
    share: str | None = None,
) -> None:
    """Mine recordings, write the dataset, and print a summary.

    Exits with 1 if a recording or a rule has an error.

    Args:
        given: files, folders, patterns, URLs, and lists as @FILE.
        output: the folder of the dataset, created if it is missing.
        detector: a file with one Detector.
        rules: files or folders with EventRules.
        processes: the number of worker processes; None: one for each core that this process may use.
        dask: the address of a Dask scheduler, whose workers do the work; None: processes of this machine.
        record: run the rules' record actions.
        sample: mine only this number of recordings, chosen at random, but the same ones each time.
        limit: mine only the first recordings, by name.
        share: as NUMBER/OF: mine one share of the recordings, counted from 0; other processes mine the rest.

    Raises:
        ClusterError: the Dask cluster cannot be used.
        MissingExtraError: a package is not installed.
        DocumentError, DetectorError, RecordingError, OSError: a file cannot be used; the text gives the reason.
    """
    check_package("pyarrow", "detector mine", "mining")
    part = None if share is None else _share(share)
    loaded = load_rules(detector, rules, lasting_problems)
    for warning in loaded.warnings:
        typer.echo(warning, err=True)
    if not loaded.rule_set.rules:
        refuse("the Detector selects none of the rules: correct spec.ruleSelector, or give other --rules")
    sources = sources_of(given)
    if sample is not None:
        sources = sampled(sources, sample)
    sources = sources[:limit]
    workers = _workers(processes, dask)
    console = Console(stderr=True)
    try:
        with _Bar(console) as bar:
            run = run_mining(
                sources,
                output,
                loaded.rule_set.detector,
                loaded.rule_set.rules,
                workers,
                bar,
                record=record,
                share=part,
            )
    finally:
        workers.close()
    if not run.complete:
        typer.echo(f"{_did(run)}; other shares are not finished yet: the last one writes the dataset", err=True)
        return
    summary = summary_of(output)
    if run.changed or not (output / REPORT).exists():
        write_mining_report(output, summary)
    show(table_console(stderr=True), summary)
    _finish(run, summary, output, shared=part is not None)


def _finish(run: MiningRun, summary: Summary, output: Path, *, shared: bool) -> None:
    """Print the errors and the last line. A share fails only if another attempt may help."""
    for cut in run.cut:
        whole = ", ".join(f"{rule} ({why})" for rule, why in sorted(cut.whole.items()))
        typer.echo(f"{cut.name}: cut into {cut.pieces} pieces" + (f"; not cut for {whole}" if whole else ""), err=True)
    for error in summary.errors[:_ERRORS]:
        what = "" if error["kind"] == "unreadable" else f"{error['kind']}: "
        typer.echo(f"{error['recording']}: {what}{error['message']}", err=True)
    kinds = Counter(error["kind"] for error in summary.errors)
    if len(summary.errors) > _ERRORS:
        typer.echo(f"and {len(summary.errors) - _ERRORS} more: see errors.parquet", err=True)
    episodes = sum(rule.episodes for rule in summary.rules)
    parts = [f"{run.recordings} recordings", f"{summary.seconds / 3600:.1f} hours", f"{summary.samples} samples"]
    parts += [f"{episodes} episodes", *(f"{count} {kind}" for kind, count in sorted(kinds.items()))]
    typer.echo(f"{', '.join(parts)}; {_did(run)}: {output}", err=True)
    if kinds["failed"] or (not shared and set(kinds) - {"cut"}):
        raise typer.Exit(1)


def _did(run: MiningRun) -> str:
    if not run.mined:
        return "nothing left to mine"
    rules = f"{len(run.rules_run)} rules" if len(run.rules_run) > _NAMES else ", ".join(sorted(run.rules_run))
    return f"{run.mined} mined now, with {rules}"


def _workers(processes: int | None, dask: str | None) -> Workers:
    """Raises ClusterError."""
    if dask is None:
        return LocalWorkers(processes or len(os.sched_getaffinity(0)))
    if processes is not None:
        refuse("give either --processes, for this machine, or --dask, whose cluster has its own workers")
    check_package("distributed", "--dask", "dask")
    from detector.mining.dask import DaskWorkers  # noqa: PLC0415  an extra

    return DaskWorkers(dask)


def _share(text: str) -> WorkShare:
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if found is None or int(found[1]) >= int(found[2]):
        refuse(f"--share must be NUMBER/OF, counted from 0, e.g. 0/8 to 7/8; got {text}")
    return WorkShare(int(found[1]), int(found[2]))


class _Bar:
    """Progress on a terminal; nothing in a pipe."""

    def __init__(self, console: Console) -> None:
        self._recordings = 0
        self._progress = Progress(
            TextColumn("mining"),
            BarColumn(),
            TextColumn("{task.fields[done]} of {task.fields[recordings]} recordings, {task.percentage:.0f}%, about"),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=600,
        )
        self._task = self._progress.add_task("", total=None, done=0, recordings="?")

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def expect(self, recordings: int, amount: int) -> None:
        """See `MiningProgress`."""
        self._progress.update(self._task, total=amount, recordings=recordings)

    def done(self, amount: int) -> None:
        """See `MiningProgress`."""
        self._recordings += 1
        self._progress.update(self._task, advance=amount, done=self._recordings)
