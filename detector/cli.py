"""The command `detector`: run, replay, check, and the commands that ask one that runs."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import Annotated

import typer
from pydantic import TypeAdapter, ValidationError
from rich.console import Console

from detector import inquiry
from detector import recordings as requested_recordings
from detector.actions.deploy.file_store import write_tasks_yaml
from detector.assembly import DetectorError
from detector.catalog.command import command as catalog_command
from detector.checking import findings, summary
from detector.cluster.errors import NoClusterError
from detector.comparison import write_comparison
from detector.engine.episodes.demands import from_task
from detector.engine.episodes.events import Event
from detector.engine.scoping.plugins import PluginHost
from detector.plugins.outages import Outages
from detector.plugins.processes import REPLAY_PATIENCE, ProcessHost
from detector.replay.errors import RecordingError
from detector.replay.gathering import recordings_of
from detector.replay.intake_file import is_intake_file, read_intake, recorded_outages
from detector.replay.playing import name_of, play
from detector.replay.progress import Progress
from detector.replay.replaying import Outcome, replay_intake
from detector.rules.files import load_rules
from detector.rules.selection import select
from detector.service import Files, Named, Options
from detector.service import run as run_service
from detector.streams.asking import NoAnswerError
from detector.streams.zenoh import NetworkError
from detector.tracing import episode_traces
from wayside import commandline
from wayside.api import ApplicationTask, Detector, EventRule
from wayside.api.applicationtask import Holder
from wayside.api.documents import Document, DocumentError, load_documents
from wayside.commandline import leave, refuse

app = typer.Typer(
    help="Detects developer-defined events in the data of vehicles and roadside stations, and acts on them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)

_EXPECTED = (
    DocumentError,
    DetectorError,
    RecordingError,
    NetworkError,
    NoAnswerError,
    NoClusterError,
    OSError,
)
"""Errors of the input: said in one line, without a trace."""

DetectorFile = Annotated[Path | None, typer.Option("--detector", help="A YAML file with one Detector.")]
RuleFiles = Annotated[
    list[Path] | None, typer.Option("--rules", help="YAML files or folders with EventRules; may be repeated.")
]


@app.callback()
def _main(
    debug: Annotated[bool, typer.Option(commandline.DEBUG, help="Show the trace of an error, and log more.")] = False,
) -> None:
    logging.basicConfig(
        level=logging.DEBUG if debug else logging.INFO,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
        stream=sys.stderr,
    )
    if not debug:
        logging.getLogger("kubernetes").setLevel(logging.WARNING)


@app.command()
def run(
    detector: DetectorFile = None,
    rules: RuleFiles = None,
    name: Annotated[
        str | None, typer.Option(help="The Detector to run: it and its EventRules are read from the API server.")
    ] = None,
    namespace: Annotated[
        str | None, typer.Option(help="With --name: the namespace. Default: the kubeconfig's, or the pod's.")
    ] = None,
    as_pod: Annotated[
        bool,
        typer.Option(
            "--as-pod",
            help="With --name: one of several that run this Detector, each in a pod of its own. The holder is "
            "<name>.<pod>, by the environment variable POD_NAME.",
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(help="A folder for events.jsonl and, without a cluster, the tasks. Default there: out."),
    ] = None,
    record_intake: Annotated[
        Path | None, typer.Option(help="Write all that the engine consumes into this file, for an exact replay.")
    ] = None,
    metrics_port: Annotated[
        int | None,
        typer.Option(help="Serve /metrics, /healthz and /readyz on this port; 0: on a free one.", min=0, max=65535),
    ] = None,
) -> None:
    """Detect events live: with files (--detector, --rules), or in a cluster (--name)."""
    if (name is None) == (detector is None):
        refuse("give either --detector FILE and --rules FILE, or --name NAME")
    if name is not None:
        if rules:
            refuse("--rules goes with --detector; with --name the rules are read from the API server")
        holder = _holder_in_pod(name) if as_pod else name
        options = Options(Named(name, namespace, output, holder), record_intake, metrics_port)
    else:
        assert detector is not None  # noqa: S101  one of both is given
        if namespace is not None:
            refuse("--namespace goes with --name; a Detector in a file says its namespace itself")
        if as_pod:
            refuse("--as-pod goes with --name; a Detector in a file is held by its name")
        options = Options(Files(detector, tuple(rules or ()), output or Path("out")), record_intake, metrics_port)
    asyncio.run(run_service(options))
    leave()


def _holder_in_pod(name: str) -> str:
    pod = os.environ.get("POD_NAME", "")
    try:
        return TypeAdapter(Holder).validate_python(f"{name}.{pod}" if pod else "")
    except ValidationError:
        refuse(
            f"--as-pod: the holder {name}.{pod} is none: give POD_NAME by the downward API (metadata.name); the "
            "two names have room for 252 characters"
        )


@app.command()
def replay(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Intake files, MCAP files, rosbag2 folders, ROS 1 bags, captures, JSON lines; folders and patterns "
            "of these. Each recording is replayed on its own."
        ),
    ],
    output: Annotated[Path, typer.Option(help="The folder for events.jsonl and tasks.yaml.")],
    detector: DetectorFile = None,
    rules: RuleFiles = None,
    compared: Annotated[
        tuple[str, str] | None,
        typer.Option("--compare", help="Compare the episodes of two rules, and write comparison.json."),
    ] = None,
    as_one: Annotated[
        bool, typer.Option("--as-one", help="Play all recordings as one, merged by time: they are of one drive.")
    ] = False,
) -> None:
    """Run the same engine over recordings. An intake file brings its Detector and rules along."""
    with Progress(Console(stderr=True)) as progress:
        played = _replayed(recordings, detector, rules, as_one, progress)
    outcomes = [outcome for _, outcome in played]
    output.mkdir(parents=True, exist_ok=True)
    traced = [_traced(outcome) for outcome in outcomes]
    with (output / "events.jsonl").open("w", encoding="utf-8") as file:
        file.writelines(event.to_json() + "\n" for events, _ in traced for event in events)
    write_tasks_yaml(output / "tasks.yaml", [task for _, tasks in traced for task in tasks])
    if compared is not None:
        write_comparison(outcomes, compared, output)
    refusals = dict.fromkeys(str(refusal) for outcome in outcomes for refusal in outcome.refusals)
    for refusal in refusals:
        typer.echo(refusal, err=True)
    for name, outcome in played:
        for line in _lines(outcome):
            typer.echo(line if len(played) == 1 else f"{name}: {line}", err=True)
    typer.echo(f"{_counted(outcomes)}: {output}", err=True)
    if refusals:
        raise typer.Exit(1)


def _lines(outcome: Outcome) -> Iterator[str]:
    """What a person should know of a recording."""
    yield from (f"warning: {doubt}" for doubt in outcome.doubts)
    yield from outcome.notes
    if outcome.cut:
        yield "the intake file ends in the middle: its detector was killed"
    if outcome.lost:
        yield f"the intake file lacks {outcome.lost} samples, the disk being too slow: events may differ"


def _counted(outcomes: Sequence[Outcome]) -> str:
    events = [event for outcome in outcomes for event in outcome.events]
    started = sum(event.started for event in events)
    several = f"{len(outcomes)} recordings, " if len(outcomes) > 1 else ""
    return (
        f"{several}{sum(outcome.samples for outcome in outcomes)} samples, {started} episodes started, "
        f"{len(events) - started} ended, {sum(len(outcome.tasks) for outcome in outcomes)} tasks"
    )


@app.command()
def check(
    files: Annotated[list[Path], typer.Argument(help="YAML files or folders.")],
    recordings: Annotated[
        list[Path] | None,
        typer.Option(
            "--recording",
            help="Also replay this recording, and warn where rules use old samples; may be repeated.",
        ),
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 where there is a warning, too.")] = False,
) -> None:
    """Compile and type-check EventRules and Detectors; exit with 1 where something is wrong.

    A classification that contradicts its rule is a warning.
    """
    try:
        documents = load_documents(files)
    except DocumentError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(1) from None
    problems, warnings = findings(documents)
    for problem in problems:
        typer.echo(str(problem), err=True)
    for warning in warnings:
        typer.echo(warning.as_warning(), err=True)
    doubted = [] if problems or not recordings else _doubts(documents, recordings)
    for doubt in doubted:
        typer.echo(f"warning: {doubt}", err=True)
    if problems or (strict and (warnings or doubted)):
        raise typer.Exit(1)
    count = len(warnings) + len(doubted)
    doubts = f", {count} warning{'s' if count > 1 else ''}" if count else ""
    typer.echo(f"{summary(documents)}: nothing wrong{doubts}", err=True)


def _doubts(documents: Sequence[Document], recordings: Sequence[Path]) -> list[str]:
    """What the recordings show of the Detectors and their rules."""
    gathered = recordings_of(recordings)
    rules = [document.object for document in documents if isinstance(document.object, EventRule)]
    found: list[str] = []
    for detector in (document.object for document in documents if isinstance(document.object, Detector)):
        selected = select(detector, rules).rules
        for outcome in play(gathered, detector, selected, lambda: _plugins(Outages(lambda: ()))):
            found += outcome.doubts
    return list(dict.fromkeys(found))


app.add_typer(requested_recordings.app, name="recordings")
app.command("catalog")(catalog_command)

for command in (inquiry.status, inquiry.evaluate, inquiry.pause, inquiry.resume):
    app.command()(command)


def _plugins(outages: Outages) -> AbstractContextManager[PluginHost]:
    """Runs the plugins of one replay in processes of their own."""
    return closing(ProcessHost(outages, wait=True, patience=REPLAY_PATIENCE))


def _replayed(
    recordings: list[Path], detector: Path | None, rules: list[Path] | None, as_one: bool, progress: Progress
) -> list[tuple[str, Outcome]]:
    """What each recording came to, by its name."""
    if recordings[0].exists() and is_intake_file(recordings[0]):
        if len(recordings) > 1:
            refuse("an intake file is replayed alone: give one recording")
        return [(str(recordings[0]), _intake_replayed(recordings[0], detector, rules, progress))]
    if detector is None:
        refuse("give --detector FILE and --rules FILE: only an intake file brings its own")
    loaded = load_rules(detector, rules or ())
    for warning in loaded.warnings:
        typer.echo(warning, err=True)
    gathered = recordings_of(recordings, as_one=as_one)
    outcomes = play(
        gathered,
        loaded.rule_set.detector,
        loaded.rule_set.rules,
        lambda: _plugins(Outages(lambda: ())),
        progress.watch,
    )
    return list(zip(map(name_of, gathered), outcomes, strict=True))


def _intake_replayed(recording: Path, detector: Path | None, rules: list[Path] | None, progress: Progress) -> Outcome:
    if detector is None and rules:
        refuse("give --detector as well: rules are compiled against their Detector")
    given = None if detector is None else load_rules(detector, rules or ()).rule_set
    with _plugins(Outages(lambda: recorded_outages(recording) if detector is None else ())) as plugins:
        return replay_intake(
            progress.watch(read_intake(recording)),
            None if given is None else given.detector,
            given.rules if given is not None and rules else None,
            plugins,
        )


def _traced(outcome: Outcome) -> tuple[Iterable[Event], Iterable[ApplicationTask]]:
    """The events and tasks; with where they stand in traces, as live, where the environment asks for traces."""
    with episode_traces(export=False) as traces:
        if traces is None:
            return outcome.events, outcome.tasks.values()
        demands = ((task, from_task(task)) for task in outcome.tasks.values())
        tasks = [task if demand is None else traces.task(demand, task) for task, demand in demands]
        return [traces.event(event) for event in outcome.events], tasks


def main() -> None:
    """The console script."""
    sys.exit(commandline.run(app, "detector", _EXPECTED, sys.argv[1:]))


if __name__ == "__main__":
    main()
