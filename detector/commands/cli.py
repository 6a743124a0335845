"""The command `detector`: run, replay, check, and the commands that query a running one.

Commands are declared here and in the modules added below; a command imports its implementation when it runs.
"""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from detector.commands import inquiry, recordings
from detector.commands.catalog.command import command as catalog_command
from detector.commands.mine_command import mine
from detector.results.kinds import ResultKind, chosen
from wayside.inputerror import InputError
from wayside.process import commandline
from wayside.process.commandline import leave, refuse
from wayside.process.startup import importing

if TYPE_CHECKING:
    from detector.live.running import EvaluationView

app = typer.Typer(
    help="Detects developer-defined events in the data of vehicles and roadside stations, and acts on them.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)

_EXPECTED = (InputError, OSError)
"""Errors of the input: printed on one line, without a traceback."""

DetectorFile = Annotated[Path | None, typer.Option("--detector", help="A YAML file with one Detector.")]
RuleFiles = Annotated[
    list[Path] | None, typer.Option("--rules", help="YAML files or folders with EventRules; may be repeated.")
]


@app.callback()
def _main(debug: commandline.Debug = False) -> None:
    commandline.log_to_stderr("%(asctime)s %(levelname)s %(name)s: %(message)s", debug=debug)
    if not debug:
        logging.getLogger("kubernetes").setLevel(logging.WARNING)


@app.command()
def run(
    detector: DetectorFile = None,
    rules: RuleFiles = None,
    name: Annotated[
        str | None,
        typer.Option(help=("The Detector to run: the detector reads it and its EventRules from the API server.")),
    ] = None,
    namespace: Annotated[
        str | None, typer.Option(help="With --name: the namespace. Default: the kubeconfig's, or the pod's.")
    ] = None,
    as_pod: Annotated[
        bool,
        typer.Option(
            "--as-pod",
            help=(
                "With --name: this is one of several pods that run this Detector. The holder is <name>.<pod>; "
                "the environment variable POD_NAME gives the pod."
            ),
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            help="A folder for events.jsonl and, without a cluster, the tasks. Default without a cluster: out."
        ),
    ] = None,
    record_intake: Annotated[
        Path | None,
        typer.Option(help=("Write everything that the engine consumes into this file, for an exact replay.")),
    ] = None,
    metrics_port: Annotated[
        int | None,
        typer.Option(help="Serve /metrics, /healthz and /readyz on this port; 0: on any free port.", min=0, max=65535),
    ] = None,
    metrics_certificates: commandline.MetricsCertificates = None,
    foxglove: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:]PORT",
            help="Serve a live view for Foxglove and Lichtblick, e.g. 8765. Without a host, only this machine "
            "reaches it.",
        ),
    ] = None,
    log_format: commandline.LogFormatOption = commandline.LogFormat.TEXT,
) -> None:
    """Detect events live: with files (--detector, --rules), or in a cluster (--name)."""
    commandline.log_as(log_format)
    if (name is None) == (detector is None):
        refuse("give either --detector FILE and --rules FILE, or --name NAME")
    if name is not None and rules:
        refuse("--rules requires --detector; with --name the rules are read from the API server")
    if detector is not None and namespace is not None:
        refuse("--namespace requires --name; a Detector in a file names its namespace itself")
    if detector is not None and as_pod:
        refuse("--as-pod requires --name; the holder of a Detector in a file is its name")
    if metrics_certificates is not None and metrics_port is None:
        refuse("--metrics-certificates requires --metrics-port")
    with importing():
        import asyncio

        from detector.live.running import RunOptions
        from detector.live.service import FromCluster, FromFiles, run_detector
        from detector.status.server import PagesAddress

    pages = None if metrics_port is None else PagesAddress(metrics_port, metrics_certificates)
    if name is not None:
        holder = _holder_in_pod(name) if as_pod else name
        source: FromFiles | FromCluster = FromCluster(name, namespace, holder)
    else:
        assert detector is not None  # noqa: S101  one of the two is given
        output = output or Path("out")
        source = FromFiles(detector, tuple(rules or ()), output)
    asyncio.run(run_detector(source, RunOptions(output, record_intake, pages, _view(foxglove))))
    leave()


def _view(address: str | None) -> EvaluationView | None:
    if address is None:
        return None
    host, _, port = address.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        refuse(f"--foxglove must be a port, e.g. 8765, or host and port, e.g. 0.0.0.0:8765; got {address}")
    with importing():
        from detector.results.kinds import check_package

        check_package("foxglove", "--foxglove")
        from detector.results.live import LiveView

    return LiveView(host or "127.0.0.1", int(port))


def _holder_in_pod(name: str) -> str:
    from pydantic import TypeAdapter, ValidationError

    from wayside.api.applicationtask import Holder

    pod = os.environ.get("POD_NAME", "")
    try:
        return TypeAdapter(Holder).validate_python(f"{name}.{pod}" if pod else "")
    except ValidationError:
        refuse(
            f"--as-pod: {name}.{pod} is not a valid holder: set POD_NAME with the downward API "
            "(metadata.name); both names together may have 252 characters"
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
    as_one: Annotated[
        bool, typer.Option("--as-one", help="Play all recordings as one, merged by time, for recordings of one drive.")
    ] = False,
    results: Annotated[
        list[ResultKind] | None,
        typer.Option(
            help="Also write report.html, results.mcap for Foxglove, or the table of episodes as Parquet and CSV; "
            "or all of them. May be repeated."
        ),
    ] = None,
    sets: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="RULE.FIELD=VALUE",
            help="Also play the rule with another value of a field, e.g. close.when='distance < 120', and compare the "
            "two; or RULE=OTHER: compare the rule with another one; may be repeated.",
        ),
    ] = None,
    sweeps: Annotated[
        list[str] | None,
        typer.Option(
            "--sweep",
            metavar="RULE.FIELD=FIRST:LAST:STEP",
            help="Like --set, with several values in one pass, e.g. close.parameters.distance=80:200:20, or 80,120; "
            "may be repeated.",
        ),
    ] = None,
    record: Annotated[
        bool, typer.Option("--record", help="Run the rules' record actions, into the folder clips of the output.")
    ] = False,
) -> None:
    """Evaluate rules over recordings, with the engine of `run`. An intake file contains its Detector and rules."""
    with importing():
        from detector.assembly.memory import tune_garbage_collection
        from detector.commands.replay import replay_files

    tune_garbage_collection()  # otherwise a third of the reading time goes to the search for cycles among samples
    replay_files(
        recordings,
        output,
        detector,
        rules or (),
        as_one=as_one,
        kinds=chosen(results),
        sets=sets or (),
        sweeps=sweeps or (),
        record=record,
    )


@app.command()
def topics(
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(help="Recordings of any kind that replay reads; folders and patterns of these."),
    ] = None,
    as_yaml: Annotated[
        bool, typer.Option("--yaml", help="Print a Detector whose streams match all keys found.")
    ] = False,
    live: Annotated[bool, typer.Option("--live", help="Listen on Zenoh instead of reading recordings.")] = False,
    connect: Annotated[
        list[str] | None,
        typer.Option(
            help="With --live: Zenoh endpoints, e.g. tcp/127.0.0.1:7447. Default: discover them in the local network."
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(help="With --live: how long to listen.", min=0.1)] = 5.0,
) -> None:
    """List the contents of recordings: keys, types, rates, gaps, clients, and fields as paths to paste into rules."""
    if live == bool(recordings):
        refuse("give recordings, or --live")
    if connect and not live:
        refuse("--connect requires --live")
    with importing():
        from detector.commands.topics.command import list_live_topics, list_topics

    if live:
        list_live_topics(connect or (), seconds, as_yaml=as_yaml)
    else:
        list_topics(recordings or (), as_yaml=as_yaml)


@app.command("try")
def try_(
    expression: Annotated[str, typer.Argument(help="CEL over msg, e.g. msg.twist.twist.linear.x * 3.6.")],
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings of any kind that replay reads; folders and patterns of these.")
    ],
    stream: Annotated[
        str | None,
        typer.Option(
            help=("The stream, as named by `detector topics --yaml`. Default: the stream that has the fields.")
        ),
    ] = None,
    every: Annotated[str, typer.Option(help="Time between two evaluations.")] = "100ms",
) -> None:
    """Print the values of one expression over the messages of recordings, by client; no file is needed."""
    with importing():
        from detector.commands.trying import try_expression

    try_expression(expression, recordings, stream, every)


@app.command()
def new(
    case: Annotated[str | None, typer.Argument(help="The use case; without it, all are listed.")] = None,
    stream: Annotated[str, typer.Option(help="The stream that the rule reads.")] = "odom",
    name: Annotated[str | None, typer.Option(help="The rule's name. Default: the name of the use case.")] = None,
) -> None:
    """Print an example rule for a use case, to start from."""
    with importing():
        from detector.commands.drafts import drafts, rule_draft

    if case is not None:
        typer.echo(rule_draft(case, stream, name), nl=False)
        return
    found = drafts()
    width = max(map(len, found))
    for each, about in found.items():
        typer.echo(f"{each:{width}}  {about}")


@app.command()
def schema(
    output: Annotated[Path | None, typer.Option(help="The file to write. Default: print it.")] = None,
) -> None:
    """Write the JSON Schema of all kinds, for editors that complete and check YAML."""
    with importing():
        import json

        from wayside.api.schema import editor_schema

    text = json.dumps(editor_schema(), indent=1) + "\n"
    if output is None:
        typer.echo(text, nl=False)
    else:
        output.write_text(text, encoding="utf-8")


@app.command()
def check(
    files: commandline.CheckedFiles = None,
    recordings: Annotated[
        list[Path] | None,
        typer.Option(
            "--recording",
            help=(
                "Also replay this recording: warn of fields and streams that it does not contain, and of rules "
                "that use old samples. May be repeated."
            ),
        ),
    ] = None,
    strict: commandline.StrictCheck = False,
    ignore: commandline.IgnoredFindings = None,
    listing: commandline.ListFindings = False,
) -> None:
    """Compile and type-check EventRules and Detectors; exit with 1 if there are errors.

    Each finding has a name. A classification that contradicts its rule is a warning.
    """
    if not listing and not files:
        refuse("give YAML files or folders, or --list")
    with importing():
        from detector.commands.checking import check_files, list_checks

    if listing:
        list_checks()
    else:
        check_files(files or (), recordings or (), ignore or (), strict=strict)


app.add_typer(recordings.app, name="recordings")
app.command("catalog")(catalog_command)

for command in (inquiry.status, inquiry.evaluate, inquiry.pause, inquiry.resume, mine):
    app.command()(command)


def main() -> None:
    """The entry point of the console script."""
    sys.exit(commandline.run_cli(app, "detector", _EXPECTED, sys.argv[1:]))


if __name__ == "__main__":
    main()
