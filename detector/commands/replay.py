"""What `detector replay` runs: recordings in, events and tasks out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path

import typer
from rich.console import Console

from detector.actions.deploy.file_store import write_tasks_yaml
from detector.comparison import write_comparison
from detector.engine.episodes.demands import from_task
from detector.engine.episodes.events import Event
from detector.engine.scoping.plugins import PluginHost
from detector.plugins.outages import Outages
from detector.plugins.processes import REPLAY_PATIENCE, ProcessHost
from detector.replay.intake_file import is_intake_file, read_intake, recorded_outages
from detector.replay.latched import recorded_arrivals
from detector.replay.progress import Progress
from detector.replay.recorded_types import with_recorded_types
from detector.replay.replaying import Outcome, replay_arrivals, replay_intake
from detector.replay.routing import Router
from detector.rules.files import load_rules
from detector.tracing import episode_traces
from wayside.api import ApplicationTask
from wayside.commandline import refuse


def replay_files(
    recordings: Sequence[Path],
    output: Path,
    detector: Path | None,
    rules: Sequence[Path],
    compared: tuple[str, str] | None,
) -> None:
    """Replay, write the results into the folder, and print a summary; exits with 1 where a rule is refused.

    Args:
        recordings: at least one.
        output: the folder for events.jsonl and tasks.yaml, made where it is missing.
        detector: a file with one Detector; None: the intake file brings its own.
        rules: files or folders with EventRules.
        compared: the names of two rules whose episodes are compared; None: nothing is compared.

    Raises:
        DocumentError, DetectorError, RecordingError, OSError: a file cannot be used; the text says why.
    """
    plugins = ProcessHost(
        Outages(lambda: recorded_outages(recordings[0]) if detector is None else ()),
        wait=True,
        patience=REPLAY_PATIENCE,
    )
    with Progress(Console(stderr=True)) as progress, closing(plugins):
        outcome = _replayed(recordings, detector, rules, progress, plugins)
    output.mkdir(parents=True, exist_ok=True)
    events, tasks = _traced(outcome)
    with (output / "events.jsonl").open("w", encoding="utf-8") as file:
        file.writelines(event.to_json() + "\n" for event in events)
    write_tasks_yaml(output / "tasks.yaml", tasks)
    if compared is not None:
        write_comparison(outcome, compared, output)
    for refusal in outcome.refusals:
        typer.echo(str(refusal), err=True)
    for note in outcome.notes:
        typer.echo(note, err=True)
    if outcome.cut:
        typer.echo("the intake file ends in the middle: its detector was killed", err=True)
    if outcome.lost:
        typer.echo(
            f"the intake file lacks {outcome.lost} samples, the disk being too slow: events may differ", err=True
        )
    started = sum(event.started for event in outcome.events)
    typer.echo(
        f"{outcome.samples} samples, {started} episodes started, {len(outcome.events) - started} ended, "
        f"{len(outcome.tasks)} tasks: {output}",
        err=True,
    )
    if outcome.refusals:
        raise typer.Exit(1)


def _replayed(
    recordings: Sequence[Path], detector: Path | None, rules: Sequence[Path], progress: Progress, plugins: PluginHost
) -> Outcome:
    if recordings[0].exists() and is_intake_file(recordings[0]):
        if len(recordings) > 1:
            refuse("an intake file is replayed alone: give one recording")
        if detector is None and rules:
            refuse("give --detector as well: rules are compiled against their Detector")
        given = None if detector is None else load_rules(detector, rules).rule_set
        return replay_intake(
            progress.watch(read_intake(recordings[0])),
            None if given is None else given.detector,
            given.rules if given is not None and rules else None,
            plugins,
        )
    if detector is None:
        refuse("give --detector FILE and --rules FILE: only an intake file brings its own")
    loaded = load_rules(detector, rules)
    for warning in loaded.warnings:
        typer.echo(warning, err=True)
    completed = with_recorded_types(loaded.rule_set.detector, recordings)
    router = Router(completed.spec.streams)
    arrivals = recorded_arrivals(recordings, router, completed)
    outcome = replay_arrivals(progress.watch(arrivals), completed, loaded.rule_set.rules, plugins)
    if not outcome.samples:
        keys = ", ".join(router.unrouted) or "none"
        typer.echo(f"no message belongs to a stream of the Detector; keys in the recording: {keys}", err=True)
    return outcome


def _traced(outcome: Outcome) -> tuple[Iterable[Event], Iterable[ApplicationTask]]:
    """The events and tasks; with where they stand in traces, as live, where the environment asks for traces."""
    with episode_traces(export=False) as traces:
        if traces is None:
            return outcome.events, outcome.tasks.values()
        demands = ((task, from_task(task)) for task in outcome.tasks.values())
        tasks = [task if demand is None else traces.task(demand, task) for task, demand in demands]
        return [traces.event(event) for event in outcome.events], tasks
