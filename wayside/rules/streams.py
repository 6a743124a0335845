"""The streams of a Detector: their expressions (stamp, position, items and client), and their sources."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from wayside.api import Detector
from wayside.api.plugin import ZENOH
from wayside.api.stream import Stream
from wayside.api.validation_errors import FieldPath
from wayside.expressions import CelType, ExpressionError, InterpolationError, compile_template
from wayside.keys import KeyPattern, KeyPatternError
from wayside.names import did_you_mean
from wayside.rules.compiled import CompiledStream
from wayside.rules.fields import Fields, ItemFields, fields_at, unknown_fields
from wayside.rules.problems import RuleError, RuleProblem
from wayside.rules.variables import items_environment, naming_environment, sample_environment, stamp_environment


def compile_stream(stream: Stream, index: int, fields: Fields | None = None) -> CompiledStream:
    """The compiled expressions of the stream.

    Raises:
        RuleError: with every problem of the expressions.
    """
    problems = list(stream_problems(stream, index, fields))
    if problems:
        raise RuleError(problems)
    stamp = None if stream.stamp is None else stamp_environment().compile(stream.stamp, result=CelType.DOUBLE)
    of_items = stream.items is not None
    client = compile_template(stream.client, naming_environment(items=of_items)) if stream.names_by_message else None
    items = None if stream.items is None else items_environment().compile(stream.items, result=CelType.LIST)
    return CompiledStream(stream.name, stamp, client, items)


def stream_problems(stream: Stream, index: int, fields: Fields | None = None) -> Iterable[RuleProblem]:
    """The problems of a Detector's stream: of its key and of its expressions."""
    try:
        KeyPattern.parse(stream.key)
    except KeyPatternError as error:
        yield RuleProblem(("spec", "streams", index, "key"), str(error))
    if stream.items is not None:
        yield from _items_problems(stream.items, ("spec", "streams", index, "items"), fields)
    if stream.names_by_message:
        yield from _naming_problems(stream, ("spec", "streams", index, "client"), fields)
    for axis, source in {} if stream.position is None else stream.position.axes.items():
        yield from _sample_problems(("spec", "streams", index, "position", axis), source, stream, fields)
    if stream.stamp is None:
        return
    path: FieldPath = ("spec", "streams", index, "stamp")
    try:
        expression = stamp_environment().compile(stream.stamp, result=CelType.DOUBLE)
    except ExpressionError as error:
        received = stream.stamp.strip() == "t" and "; for the field t of JSON lines, write sample.received"
        yield from (RuleProblem(path, f"{each}{received or ''}") for each in (error, *error.others))
        return
    for variable, members in (("sample", {"received": None}), ("msg", fields)):
        if members is not None:
            yield from (RuleProblem(path, text) for text in unknown_fields(expression.paths, variable, members))


def _sample_problems(path: FieldPath, source: str, stream: Stream, fields: Fields | None) -> Iterable[RuleProblem]:
    """The problems of an expression that computes a number from a sample."""
    try:
        expression = sample_environment(items=stream.items is not None).compile(source, result=CelType.DOUBLE)
    except ExpressionError as error:
        yield from (RuleProblem(path, str(each)) for each in (error, *error.others))
        return
    if "parameters" in expression.names:
        yield RuleProblem(path, "a stream cannot use parameters, which belong to a rule: write the number itself")
    for variable, known in (("msg", fields), ("item", item_fields(stream, fields))):
        if known is not None:
            yield from (RuleProblem(path, text) for text in unknown_fields(expression.paths, variable, known))


def item_fields(stream: Stream, fields: Fields | None) -> Fields | None:
    """The fields of the stream's items, from the `fields` of its messages; None if they are unknown."""
    if stream.items is None or fields is None:
        return None
    try:
        path = items_environment().compile(stream.items).path
    except ExpressionError:
        return None
    found = None if path is None else fields_at(path[1:], fields)
    return dict(found) if isinstance(found, ItemFields) else None


def _items_problems(items: str, path: FieldPath, fields: Fields | None) -> Iterable[RuleProblem]:
    """The problems of an `items` expression."""
    try:
        expression = items_environment().compile(items, result=CelType.LIST)
    except ExpressionError as error:
        yield from (RuleProblem(path, str(each)) for each in (error, *error.others))
        return
    if fields is None:
        return
    wrong = [*unknown_fields(expression.paths, "msg", fields)]
    yield from (RuleProblem(path, text) for text in wrong)
    plain = expression.path
    found = None if plain is None or wrong else fields_at(plain[1:], fields)
    if found is not None and not isinstance(found, ItemFields):
        yield RuleProblem(path, f"{items} is not a list: name a field that holds a list of objects")


def _naming_problems(stream: Stream, path: FieldPath, fields: Fields | None) -> Iterable[RuleProblem]:
    """The problems of a `client` template over the message."""
    of_items = stream.items is not None
    try:
        template = compile_template(stream.client, naming_environment(items=of_items))
    except InterpolationError as error:
        unlisted = "" if of_items or "`item`" not in str(error) else "; item is for streams with items: add items"
        yield from (RuleProblem(path, f"{each}{unlisted}") for each in (error, *error.others))
        return
    if of_items and "item" not in template.names:
        yield RuleProblem(path, "each item needs its own client: use item, e.g. ${item.id}")
    for variable, known in (("msg", fields), ("item", item_fields(stream, fields))):
        if known is not None:
            yield from (RuleProblem(path, text) for text in unknown_fields(template.paths, variable, known))


def source_problems(detector: Detector) -> Iterator[RuleProblem]:
    """The problems of sources and of the liveliness key: wrong or unused names, and options that only Zenoh has."""
    names = [source.name for source in detector.spec.sources]
    for index, source in enumerate(detector.spec.sources):
        if source.name == ZENOH:
            yield RuleProblem(
                ("spec", "sources", index, "name"),
                f"{ZENOH} is the session of spec.zenoh, which always exists: choose another name",
            )
        elif not any(stream.source == source.name for stream in detector.spec.streams):
            yield RuleProblem(
                ("spec", "sources", index, "name"),
                f"no stream uses {source.name}: set source: {source.name} in a stream, or remove it",
            )
    for index, stream in enumerate(detector.spec.streams):
        if stream.source in (ZENOH, *names):
            if stream.source != ZENOH and (stream.history is not None or stream.recover):
                field = "recover" if stream.history is None else "history"
                yield RuleProblem(
                    ("spec", "streams", index, field),
                    f"is valid only for streams over Zenoh, not for source {stream.source}: remove it",
                )
            continue
        hint = did_you_mean(stream.source, names) or f"there are {', '.join([ZENOH, *names])}"
        yield RuleProblem(
            ("spec", "streams", index, "source"), f"Detector {detector.name} has no source {stream.source}; {hint}"
        )
    if detector.spec.zenoh.liveliness is not None:
        try:
            KeyPattern.parse(detector.spec.zenoh.liveliness)
        except KeyPatternError as error:
            yield RuleProblem(("spec", "zenoh", "liveliness"), str(error))
