"""The expressions of a Detector's streams: the sender's time, and the client of a message."""

from __future__ import annotations

from collections.abc import Iterable

from wayside.api.stream import Stream
from wayside.api.wording import FieldPath
from wayside.expressions import ExpressionError, InterpolationError, Kind, compile_template
from wayside.keys import KeyPattern, KeyPatternError
from wayside.rules.compiled import CompiledStream
from wayside.rules.fields import Fields, unknown_fields
from wayside.rules.problems import RuleError, RuleProblem
from wayside.rules.variables import naming_environment, sample_environment, stamp_environment


def compile_stream(stream: Stream, index: int, fields: Fields | None = None) -> CompiledStream:
    """The stream's own expressions.

    Raises:
        RuleError: with every problem of them.
    """
    problems = list(stream_problems(stream, index, fields))
    if problems:
        raise RuleError(problems)
    stamp = None if stream.stamp is None else stamp_environment().compile(stream.stamp, result=Kind.DOUBLE)
    client = compile_template(stream.client, naming_environment()) if stream.names_by_message else None
    return CompiledStream(stream.name, stamp, client)


def stream_problems(stream: Stream, index: int, fields: Fields | None = None) -> Iterable[RuleProblem]:
    """The problems of a Detector's stream: of its key and its expressions."""
    try:
        KeyPattern.parse(stream.key)
    except KeyPatternError as error:
        yield RuleProblem(("spec", "streams", index, "key"), str(error))
    if stream.names_by_message:
        yield from _naming_problems(stream, ("spec", "streams", index, "client"), fields)
    for axis, source in {} if stream.position is None else stream.position.axes.items():
        yield from _sample_problems(("spec", "streams", index, "position", axis), source, fields)
    if stream.stamp is None:
        return
    path: FieldPath = ("spec", "streams", index, "stamp")
    try:
        expression = stamp_environment().compile(stream.stamp, result=Kind.DOUBLE)
    except ExpressionError as error:
        received = stream.stamp.strip() == "t" and "; write sample.received for the t of JSON lines"
        yield from (RuleProblem(path, f"{each}{received or ''}") for each in (error, *error.others))
        return
    for variable, members in (("sample", {"received": None}), ("msg", fields)):
        if members is not None:
            yield from (RuleProblem(path, text) for text in unknown_fields(expression.paths, variable, members))


def _sample_problems(path: FieldPath, source: str, fields: Fields | None) -> Iterable[RuleProblem]:
    """The problems of an expression for a number of a sample."""
    try:
        expression = sample_environment().compile(source, result=Kind.DOUBLE)
    except ExpressionError as error:
        yield from (RuleProblem(path, str(each)) for each in (error, *error.others))
        return
    if "parameters" in expression.names:
        yield RuleProblem(path, "parameters belong to a rule, and a stream has none: write the number itself")
    if fields is not None:
        yield from (RuleProblem(path, text) for text in unknown_fields(expression.paths, "msg", fields))


def _naming_problems(stream: Stream, path: FieldPath, fields: Fields | None) -> Iterable[RuleProblem]:
    """The problems of a `client` template over the message."""
    try:
        template = compile_template(stream.client, naming_environment())
    except InterpolationError as error:
        yield from (RuleProblem(path, str(each)) for each in (error, *error.others))
        return
    if fields is not None:
        yield from (RuleProblem(path, text) for text in unknown_fields(template.paths, "msg", fields))
