"""The implementation of `detector try`: one expression over the messages of recordings, by client."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import typer
from pydantic import ValidationError

from detector.assembly import stream_readers
from detector.commands.topics.doubts import fields_of
from detector.commands.topics.proposal import Proposal, detector_document, proposals
from detector.commands.topics.survey import survey
from detector.replay.gathering import recordings_of
from detector.replay.message import RecordingError
from detector.replay.playing import play
from detector.replay.recorded_types import with_recorded_types
from detector.results.series import Series, SeriesKind, Trace
from detector.results.tracing import Tracer
from wayside.api import Detector, EventRule
from wayside.api.validation_errors import messages
from wayside.process.commandline import refuse
from wayside.rules import RuleError, compile_rule

_WIDE = 40
"""Width of a plot in columns."""
_BARS = "▁▂▃▄▅▆▇█"


def try_expression(expression: str, recordings: Sequence[Path], stream: str | None, every: str) -> None:
    """Print the expression's values over time, a line for each client.

    Args:
        expression: CEL over msg, as the value of a signal.
        recordings: at least one file, folder or pattern.
        stream: as `detector topics` names it; None: the one whose messages have the fields.
        every: the time between two evaluations, e.g. 100ms.

    Raises:
        RecordingError: a recording is missing or damaged, or contains no message.
    """
    gathered = recordings_of(recordings)
    topics = survey(gathered).topics
    if not topics:
        raise RecordingError(f"{recordings[0]} contains no message")
    found = proposals(topics)
    files = [path for recording in gathered for path in recording]
    detector = with_recorded_types(Detector.model_validate(detector_document(found)), files)
    name = _stream(expression, found, detector, stream, every)
    tracers: dict[str, Tracer] = {}
    play(gathered, detector, [_rule(expression, name, every)], observer=lambda of: tracers.setdefault(of, Tracer()))
    typer.echo(f"{expression} of stream {name}")
    for recording, tracer in tracers.items():
        if len(tracers) > 1:
            typer.echo(recording)
        trace = tracer.trace()
        for line in _lines(trace):
            typer.echo(line)


def _rule(expression: str, stream: str, every: str) -> EventRule:
    spec: dict[str, Any] = {
        "evaluation": {"every": every},
        "signals": [{"name": "value", "stream": stream, "value": expression}],
        "when": "false",
    }
    head = {"apiVersion": "wayside.dev/v1alpha1", "kind": "EventRule", "metadata": {"name": "try"}}
    try:
        return EventRule.model_validate({**head, "spec": spec})
    except ValidationError as error:
        (_, text), *_ = messages(error, {"spec": spec})
        refuse(text)


def _stream(expression: str, found: Sequence[Proposal], detector: Detector, wanted: str | None, every: str) -> str:
    """The stream that the expression fits. Raises an error if none or several fit."""
    known = {**stream_readers(detector).fields, **fields_of(found)}
    names = [each.name for each in found]
    if wanted is not None and wanted not in names:
        refuse(f"--stream {wanted}: there is no such stream; the streams are {', '.join(names)}")
    problems: dict[str, str] = {}
    for name in names if wanted is None else [wanted]:
        try:
            compile_rule(_rule(expression, name, every), detector, known)
        except RuleError as error:
            problems[name] = error.problems[0].message
    fitting = [name for name in names if name not in problems and wanted in (None, name)]
    if not fitting:
        refuse(f"{expression}: {next(iter(problems.values()))}")
    if len(fitting) > 1:
        refuse(f"{expression} fits the streams {', '.join(fitting)}: give --stream {fitting[0]}")
    return fitting[0]


def _lines(trace: Trace) -> Iterator[str]:
    width = max((len(each.subject) for each in trace.subjects), default=0)
    for each in trace.subjects:
        series = each.signals.get("value")
        text = "a list or a map: name a field of it" if series is None else _summary(series, trace)
        yield f"  {each.subject:{width}}  {text}"


def _summary(series: Series, trace: Trace) -> str:
    known = ~np.isnan(series.values)
    if not known.any():
        return "unknown"
    lasting = np.diff(series.times, append=trace.end).astype(float)[known]
    values = series.values[known]
    if series.kind is SeriesKind.TEXT:
        return ", ".join(dict.fromkeys(str(series.plain(value)) for value in values.tolist()))
    mean = float(np.average(values, weights=lasting)) if lasting.sum() else float(values[0])
    if series.kind is SeriesKind.BOOLEAN:
        return f"{plot(series, trace.begin, trace.end)}  true {mean:.0%} of the time"
    facts = f"min {values.min():.6g}, mean {mean:.6g}, max {values.max():.6g}"
    return f"{plot(series, trace.begin, trace.end)}  {facts}"


def plot(series: Series, begin: int, end: int) -> str:
    """The series as a line of bars, from its least to its greatest value; a space where it is unknown."""
    times = np.linspace(begin, end, _WIDE).astype(np.int64)
    values = series.at(times)
    low, high = np.nanmin(series.values), np.nanmax(series.values)
    steps = (values - low) / (high - low or 1) * (len(_BARS) - 1)
    return "".join(" " if step != step else _BARS[round(step)] for step in steps.tolist())  # noqa: PLR0124
