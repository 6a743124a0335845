"""`detector recordings start`, `stop` and `status`: send manually the requests that triggers send to detectors."""

from __future__ import annotations

import json
import uuid
from typing import TYPE_CHECKING, Annotated

import typer

from detector.commands.inquiry import Connect, DetectorFile, Name, Timeout, query_selected
from wayside.process.commandline import refuse, table_console
from wayside.process.startup import importing

if TYPE_CHECKING:
    from detector.actions.trigger.requests import RecordingRequest

app = typer.Typer(help="Request recordings of running detectors that permit it (spec.recordings.onRequest).")

Id = Annotated[str, typer.Argument(help="The id of the recording.", show_default=False)]
Recorder = Annotated[str | None, typer.Option(help="The holder that records. Default: the holder in the file.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON, a line for each recording.")]


@app.command()
def start(
    identity: Annotated[str | None, typer.Argument(help="An id of your choice. Default: a generated one.")] = None,
    stream: Annotated[list[str] | None, typer.Option(help="A stream; may be repeated. Default: all permitted.")] = None,
    client: Annotated[list[str] | None, typer.Option(help="A client; may be repeated. Default: all.")] = None,
    before: Annotated[
        str, typer.Option(help=("How long before now the recording starts, as far as the buffer reaches."))
    ] = "0s",
    max_duration: Annotated[str, typer.Option(help="The maximum duration of the recording.")] = "10m",
    detector: DetectorFile = None,
    name: Recorder = None,
    connect: Connect = None,
    as_json: Json = False,
    timeout: Timeout = 3.0,
) -> None:
    """Begin a recording, and print its id."""
    request = _request(
        do="start",
        id=identity or f"cli-{uuid.uuid4().hex[:12]}",
        streams=stream or None,
        clients=client or None,
        before=before,
        maxDuration=max_duration,
    )
    if detector is None and name is None:
        refuse("the detector is missing: give --name NAME or --detector FILE")
    _send(request, detector, name, connect, timeout, as_json)


@app.command()
def stop(
    identity: Id,
    after: Annotated[str, typer.Option(help="How long after now the recording ends.")] = "0s",
    detector: DetectorFile = None,
    name: Recorder = None,
    connect: Connect = None,
    as_json: Json = False,
    timeout: Timeout = 3.0,
) -> None:
    """End a recording."""
    if detector is None and name is None:
        refuse("the detector is missing: give --name NAME or --detector FILE")
    _send(_request(do="stop", id=identity, after=after), detector, name, connect, timeout, as_json)


@app.command("status")
def recordings_status(
    identity: Annotated[str | None, typer.Argument(help="Only this recording.")] = None,
    detector: DetectorFile = None,
    name: Name = None,
    connect: Connect = None,
    as_json: Json = False,
    timeout: Timeout = 3.0,
) -> None:
    """List the recordings on request, running and finished."""
    _send(_request(id=identity), detector, name, connect, timeout, as_json)


def _request(**given: object) -> RecordingRequest:
    with importing():
        from pydantic import ValidationError

        from detector.actions.trigger.requests import RecordingRequest
        from wayside.api.validation_errors import messages

    try:
        return RecordingRequest.model_validate(given)
    except ValidationError as error:
        (path, text), *_ = messages(error, given)
        refuse(f"{'.'.join(map(str, path))}: {text}")


def _send(
    request: RecordingRequest,
    detector: DetectorFile,
    name: str | None,
    connect: list[str] | None,
    timeout: float,
    as_json: bool,
) -> None:
    """Print the reports, each with the detector that sent it. Exits with 1 if a recording was refused or has failed."""
    from detector.actions.trigger.requests import RECORDINGS, Progress, read_reports, write_request

    answers = query_selected(RECORDINGS, {}, detector, name, connect, timeout, write_request(request))
    reports = [(answer.holder, report) for answer in answers for report in read_reports(answer.payload)]
    if as_json:
        import msgspec

        for holder, report in reports:
            answer = {"detector": holder, **{key: value for key, value in msgspec.to_builtins(report).items() if value}}
            typer.echo(json.dumps(answer))
    else:
        from rich.table import Table

        table = Table(box=None, pad_edge=False, header_style="bold")
        for column in ("detector", "recording", "state", "until", "samples", "bytes", "files", "message"):
            table.add_column(column, overflow="fold")
        for holder, report in reports:
            counts = (report.samples, report.bytes)
            files = "\n".join(report.files)
            table.add_row(holder, report.id, report.state.value, report.until, *map(str, counts), files, report.message)
        table_console().print(table, highlight=False, markup=False)
    if any(report.state in (Progress.REFUSED, Progress.FAILED) for _, report in reports):
        raise typer.Exit(1)
