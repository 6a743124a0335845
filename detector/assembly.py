"""From the resources to an engine: decoders, keys and compiled rules. Live operation and replay do it alike."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from detector.engine.engine import Engine, KeyReader
from detector.engine.sample import Decoder
from detector.streams.codecs import UnknownTypeError, codec_for
from detector.streams.codecs.fields import message_fields
from detector.streams.keys import KeyPattern, KeyPatternError
from wayside.api import Detector, EventRule
from wayside.rules import CompiledRule, Fields, RuleError, RuleProblem, compile_rule, stream_problems

_CLIENT_NAME = re.compile(r"[A-Za-z0-9._:-]{1,63}")


class DetectorError(ValueError):
    """A Detector that cannot run; `problems` says why."""

    def __init__(self, problems: Iterable[RuleProblem]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(map(str, self.problems)))


@dataclass(frozen=True, slots=True)
class Inlets:
    """What a Detector's streams need: how their payloads and keys are read, and which fields their messages have."""

    decoders: Mapping[str, Decoder]
    read_key: KeyReader
    fields: Mapping[str, Fields]


@dataclass(frozen=True, slots=True)
class Refusal:
    """A rule that is not evaluated, and why."""

    rule: EventRule
    problems: tuple[RuleProblem, ...]


def inlets(detector: Detector) -> Inlets:
    """Decoders and key readers for the Detector's streams.

    Raises:
        DetectorError: a key that is not in key-format notation, an unknown message type, or a bad expression.
    """
    decoders: dict[str, Decoder] = {}
    patterns: dict[str, KeyPattern] = {}
    fields: dict[str, Fields] = {}
    problems: list[RuleProblem] = []
    for index, stream in enumerate(detector.spec.streams):
        at = ("spec", "streams", index)
        try:
            patterns[stream.name] = KeyPattern.parse(stream.key)
        except KeyPatternError as error:
            problems.append(RuleProblem((*at, "key"), str(error)))
        try:
            decoders[stream.name] = codec_for(stream)
        except UnknownTypeError as error:
            problems.append(RuleProblem((*at, "type"), str(error)))
            continue
        known = message_fields(stream)
        if known is not None:
            fields[stream.name] = known
        problems += stream_problems(stream, index, known)
    if problems:
        raise DetectorError(problems)
    clients = {stream.name: stream.client for stream in detector.spec.streams}

    def read_key(stream: str, key: str) -> tuple[str, Mapping[str, str]] | None:
        captures = patterns[stream].match(key)
        if captures is None:
            return None
        client = clients[stream] or captures["client"]
        return (client, captures) if _CLIENT_NAME.fullmatch(client) else None

    return Inlets(decoders, read_key, fields)


def compile_rules(
    rules: Sequence[EventRule], detector: Detector, fields: Mapping[str, Fields]
) -> tuple[list[CompiledRule], list[Refusal]]:
    """The rules that can be evaluated, and those that cannot: one does not keep the others from running."""
    compiled, refused = [], []
    for rule in rules:
        try:
            compiled.append(compile_rule(rule, detector, fields))
        except RuleError as error:
            refused.append(Refusal(rule, error.problems))
    return compiled, refused


def make_engine(detector: Detector, entries: Inlets, *, holder: str, start: int) -> Engine:
    """An engine without rules; `start` is nanoseconds since the epoch."""
    return Engine(detector, holder=holder, decoders=entries.decoders, read_key=entries.read_key, start=start)
