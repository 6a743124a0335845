"""Implements `detector replay` and `detector check --recording`: recordings in, events, tasks and findings out."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence, Set
from contextlib import AbstractContextManager, ExitStack, closing
from pathlib import Path
from typing import NamedTuple, TypeVar

import typer
from rich.console import Console

from detector.actions.deploy.file_store import write_tasks_yaml
from detector.actions.tracing import episode_traces
from detector.assembly import lasting_problems
from detector.commands.topics.doubts import topic_doubts
from detector.commands.topics.survey import survey
from detector.engine.episodes.demands import from_task
from detector.engine.episodes.events import Event
from detector.engine.samples.sample import Arrival
from detector.engine.scoping.plugins import PluginHost
from detector.findings.checks import CUT_RECORDING
from detector.plugins.outages import Outages
from detector.plugins.processes import REPLAY_PATIENCE, ProcessHost
from detector.replay.clips import Clips
from detector.replay.gathering import Recording, intake_file_of, recording_name, recordings_of
from detector.replay.intake_file import read_intake, recorded_outages
from detector.replay.message import RecordingError
from detector.replay.playing import PlayResult, play
from detector.replay.recordings import quick_span_of
from detector.replay.replaying import ReplayResult, replay_intake
from detector.replay.variants import Variant, variants_of, with_variants
from detector.resources.files import load_rules
from detector.resources.selection import select
from detector.results.kinds import ResultKind
from detector.results.variants import comparisons, show_variants, write_variants
from detector.results.writing import RecordingTrace, ResultCollector, check_installed, show_summary, write_results
from wayside.api import ApplicationTask, Detector, EventRule
from wayside.api.documents import Document, Problem
from wayside.findings import Finding, ignored_by
from wayside.process.commandline import refuse, table_console

CLIPS = "clips"
"""The folder for the output of record actions, below the output folder."""


class PlayOptions(NamedTuple):
    """The options of a replay."""

    as_one: bool
    clips: Clips | None
    sets: Sequence[str]
    sweeps: Sequence[str]


def replay_files(
    recordings: Sequence[Path],
    output: Path,
    detector: Path | None,
    rules: Sequence[Path],
    *,
    as_one: bool,
    kinds: frozenset[ResultKind] = frozenset(),
    sets: Sequence[str] = (),
    sweeps: Sequence[str] = (),
    record: bool = False,
) -> None:
    """Replay, write the results into the folder, and print a summary.

    Exits with 1 if a rule is rejected, or one of several recordings cannot be replayed.

    Args:
        recordings: at least one file, folder or pattern.
        output: the folder for events.jsonl and tasks.yaml, created if it is missing.
        detector: a file with one Detector; None: the intake file contains its own.
        rules: files or folders with EventRules.
        as_one: merge all recordings by time; otherwise each is replayed on its own.
        kinds: the kinds of results to write in addition.
        sets: fields of rules with other values, as RULE.FIELD=VALUE: a variant that is compared with the rule; or
            RULE=OTHER: another rule that is compared with it.
        sweeps: the same with several values, each a variant: RULE.FIELD=FIRST:LAST:STEP.
        record: run the rules' record actions, into the folder clips of `output`.

    Raises:
        VariantError: a variant cannot be created.
        MissingExtraError: a result needs a package that is not installed.
        DocumentError, DetectorError, RecordingError, OSError: a file cannot be used; the text gives the reason.
    """
    check_installed(kinds)
    collector = ResultCollector() if kinds else None
    with ProgressLine(Console(stderr=True)) as progress:
        clips = Clips(output / CLIPS) if record else None
        options = PlayOptions(as_one, clips, tuple(sets), tuple(sweeps))
        played, variants = _replayed(recordings, detector, rules, options, progress, collector)
        output.mkdir(parents=True, exist_ok=True)
        results = [] if collector is None else collector.results(played.outcomes)
        if results:
            progress.note("writing the results")
            write_results(output, results, kinds)
    outcomes = list(played.outcomes.values())
    tried = {variant.rule.name for variant in variants if not variant.is_written}
    traced = [_traced(outcome) for outcome in outcomes]
    with (output / "events.jsonl").open("w", encoding="utf-8") as file:
        file.writelines(
            event.to_json() + "\n" for events, _ in traced for event in events if event.episode.rule not in tried
        )
    write_tasks_yaml(output / "tasks.yaml", [task for _, tasks in traced for task in tasks])
    refusals = dict.fromkeys(str(refusal) for outcome in outcomes for refusal in outcome.refusals)
    for refusal in refusals:
        typer.echo(refusal, err=True)
    several = len(played.outcomes) + len(played.errors) > 1
    for name, outcome in played.outcomes.items():
        for line in _lines(outcome, f"{name}: " if several else ""):
            typer.echo(line, err=True)
    for error in played.errors:
        typer.echo(f"error: {error}", err=True)
    if variants:
        compared_variants = comparisons(outcomes, variants)
        write_variants(output / "variants.json", variants, compared_variants)
        show_variants(table_console(stderr=True), variants, compared_variants)
    if results:
        show_summary(table_console(stderr=True), results)
    clipped = "" if clips is None else f", {_number(clips.count, 'clip')}"
    typer.echo(f"{_counted(outcomes, tried)}{clipped}: {output}", err=True)
    if refusals or played.errors:
        raise typer.Exit(1)


def _lines(outcome: ReplayResult, where: str) -> Iterator[str]:
    """Messages about a recording for the user."""
    yield from (f"warning: {cut}" for cut in outcome.cuts)  # these name their files
    yield from (f"warning: {where}{doubt}" for doubt in outcome.doubts)
    yield from (f"{where}{note}" for note in outcome.notes)
    if outcome.cut:
        yield "the intake file is incomplete: its detector was killed"
    if outcome.lost:
        yield f"{outcome.lost} samples are missing in the intake file, since the disk was too slow: events may differ"


def _counted(outcomes: Sequence[ReplayResult], tried: Set[str]) -> str:
    events = [event for outcome in outcomes for event in outcome.events if event.episode.rule not in tried]
    started = sum(event.started for event in events)
    several = f"{len(outcomes)} recordings, " if len(outcomes) > 1 else ""
    samples = _number(sum(outcome.samples for outcome in outcomes), "sample")
    tasks = _number(sum(len(outcome.tasks) for outcome in outcomes), "task")
    return f"{several}{samples}, {_number(started, 'episode')} started, {len(events) - started} ended, {tasks}"


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def doubts_of(
    documents: Sequence[Document], recordings: Sequence[Path]
) -> tuple[list[Finding | Problem], list[RecordingError]]:
    """Findings of the recordings about the Detectors and their rules, and errors of recordings that cannot be read.

    Warnings that an annotation of the Detector or the rule ignores are left out.
    """
    intake = intake_file_of(recordings)
    gathered = [] if intake is not None else recordings_of(recordings)
    rules = [document.object for document in documents if isinstance(document.object, EventRule)]
    errors: dict[str, RecordingError] = {}
    found: list[Finding | Problem] = [] if intake is not None else [*_topic_doubts(documents, gathered, errors)]
    for detector in (document.object for document in documents if isinstance(document.object, Detector)):
        selected = select(detector, rules).rules
        if intake is not None:
            with _plugins(Outages(lambda: ())) as plugins:
                doubts = replay_intake(read_intake(intake), detector, selected, plugins).doubts
            found += _unignored(doubts, detector, selected)
            continue
        played = play(gathered, detector, selected, lambda: _plugins(Outages(lambda: ())))
        for outcome in played.outcomes.values():
            cuts = [Finding(CUT_RECORDING.name, str(each)) for each in outcome.cuts]
            found += _unignored([*cuts, *outcome.doubts], detector, selected)
        errors.update((str(error), error) for error in played.errors)
    return list(dict.fromkeys(found)), list(errors.values())


def _unignored(found: Iterable[Finding], detector: Detector, rules: Iterable[EventRule]) -> Iterator[Finding]:
    of_detector = ignored_by(detector.metadata.annotations)
    of_rules = {rule.name: ignored_by(rule.metadata.annotations) for rule in rules}
    return (each for each in found if each.check not in of_detector | of_rules.get(each.rule, frozenset()))


def _topic_doubts(
    documents: Sequence[Document], gathered: Sequence[Recording], errors: dict[str, RecordingError]
) -> Iterator[Problem]:
    """Findings from the messages alone, before the replay; errors of recordings are noted."""
    readable = []
    for recording in gathered:
        try:
            readable.append(survey([recording]).topics)
        except RecordingError as error:
            errors[str(error)] = error
    topics = [topic for each in readable for topic in each]
    if topics:
        yield from topic_doubts(documents, topics)


def _plugins(outages: Outages) -> AbstractContextManager[PluginHost]:
    """Runs the plugins of one replay in separate processes."""
    return closing(ProcessHost(outages, wait=True, patience=REPLAY_PATIENCE))


def _replayed(
    recordings: Sequence[Path],
    detector: Path | None,
    rules: Sequence[Path],
    options: PlayOptions,
    progress: ProgressLine,
    collector: ResultCollector | None,
) -> tuple[PlayResult, Sequence[Variant]]:
    """The outcome of the recordings, and the variants of rules."""
    intake = intake_file_of(recordings)
    if intake is not None:
        if options.sweeps or any("." in option.partition("=")[0] for option in options.sets):
            refuse("an intake file has no variants of rules, only --set RULE=OTHER: give the recording itself")
        name = recording_name((intake,))
        outcome = _intake_replayed(
            intake, detector, rules, progress, None if collector is None else collector.watch(name), options.clips
        )
        return PlayResult({name: outcome}, []), variants_of([*outcome.rules.values()], options.sets, ())
    if detector is None:
        refuse("give --detector FILE and --rules FILE: only an intake file contains its own")
    loaded = load_rules(detector, rules, lasting_problems)
    for warning in loaded.warnings:
        typer.echo(warning, err=True)
    gathered = recordings_of(recordings, as_one=options.as_one)
    variants = variants_of(loaded.rule_set.rules, options.sets, options.sweeps)
    made = [variant for variant in variants if not variant.is_written]
    evaluated = [*loaded.rule_set.rules, *(variant.rule for variant in made)]
    if progress.shown:
        progress.expect([quick_span_of(recording) for recording in gathered])
    played = play(
        gathered,
        with_variants(loaded.rule_set.detector, made),
        evaluated,
        lambda: _plugins(Outages(lambda: ())),
        lambda batches: progress.watch_batches(batches if collector is None else collector.batches(batches)),
        lambda name: None if collector is None else collector.watch(name).tracer,
        options.clips,
    )
    return played, variants


def _intake_replayed(
    recording: Path,
    detector: Path | None,
    rules: Sequence[Path],
    progress: ProgressLine,
    trace: RecordingTrace | None,
    clips: Clips | None,
) -> ReplayResult:
    if detector is None and rules:
        refuse("give --detector as well: rules are compiled against their Detector")
    given = None if detector is None else load_rules(detector, rules, lasting_problems).rule_set
    records = progress.watch(read_intake(recording))
    with _plugins(Outages(lambda: recorded_outages(recording) if detector is None else ())) as plugins:
        return replay_intake(
            records if trace is None else trace.arrivals.watch(records),
            None if given is None else given.detector,
            given.rules if given is not None and rules else None,
            plugins,
            None if trace is None else trace.tracer,
            clips,
        )


def _traced(outcome: ReplayResult) -> tuple[Iterable[Event], Iterable[ApplicationTask]]:
    """The events and tasks, with their trace context if the environment requests traces."""
    with episode_traces(export=False) as traces:
        if traces is None:
            return outcome.events, outcome.tasks.values()
        demands = ((task, from_task(task)) for task in outcome.tasks.values())
        tasks = [task if demand is None else traces.task(demand, task) for task, demand in demands]
        return [traces.event(event) for event in outcome.events], tasks


Record = TypeVar("Record")
Span = tuple[int, int]
"""The times of a recording's first and last message, nanoseconds since the epoch."""

_EVERY = 10_000


class ProgressLine:
    """Shows a line that is removed at the end; nothing if the console is not a terminal."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._stack = ExitStack()
        self._spans: list[Span | None] = []
        self._watched = 0
        self._begin = time.monotonic()

    def __enter__(self) -> ProgressLine:
        self._status = self._console.status("reading the recording")
        if self._console.is_terminal:
            self._stack.enter_context(self._status)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def shown(self) -> bool:
        """Whether the line is visible."""
        return self._console.is_terminal

    def expect(self, spans: Sequence[Span | None]) -> None:
        """The recordings that follow, in this order; None: the duration is not known in advance."""
        self._spans = [*spans]

    def watch(self, records: Iterable[Record]) -> Iterator[Record]:
        """The records, counted while they pass."""
        for number, record in enumerate(records, start=1):
            if number % _EVERY == 0:
                self._status.update(f"{number:,} messages replayed")
            yield record

    def watch_batches(self, batches: Iterable[Sequence[Arrival]]) -> Iterator[Sequence[Arrival]]:
        """The batches of the next recording, their messages counted while they pass."""
        number, recording = 0, self._watched
        self._watched += 1
        for batch in batches:
            number += len(batch)
            self._status.update(f"{number:,} messages replayed{self._estimate(recording, batch[-1].received)}")
            yield batch

    def note(self, what: str) -> None:
        """Show the current step."""
        self._status.update(what)

    def _estimate(self, recording: int, now: int) -> str:
        """The completed share of all recordings, and the remaining time."""
        spans = [span for span in self._spans if span is not None]
        if not spans or len(spans) < len(self._spans):
            return ""
        lengths = [last - first for first, last in spans]
        done = sum(lengths[:recording]) + min(max(now - spans[recording][0], 0), lengths[recording])
        if not done or not sum(lengths):
            return ""
        part = done / sum(lengths)
        left = (time.monotonic() - self._begin) * (1 - part) / part
        return f", {part:.0%}, about {left:.0f} s left"
