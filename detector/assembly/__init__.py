"""Builds an engine from the resources: decoders, keys and compiled rules. Shared by live operation and replay."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from detector.actions.registry import action_problems
from detector.assembly.maps import known_places
from detector.engine.buffering.naming import CLIENT_NAME
from detector.engine.engine import Engine, KeyReader
from detector.engine.samples.liveliness import LIVELINESS
from detector.engine.samples.sample import Decoder
from detector.engine.scoping.plugins import PluginHost
from detector.engine.timing.steps import ORDER
from detector.onnx.binding import bind_models
from detector.plugins.instances import LocalHost, plugin_problems
from detector.streams.codecs import DefinitionError, UnknownTypeError, codec_for
from detector.streams.codecs.definitions import Definition, DefinitionsError
from detector.streams.codecs.etsi import EtsiDecoder, OwnDefinitions, own_definitions, read_module
from detector.streams.codecs.ros import RosTypes, message_fields, standard, types_with
from wayside.api import Detector, EventRule
from wayside.api.stream import MessageDefinition
from wayside.inputerror import InputError
from wayside.keys import KeyPattern
from wayside.rules import (
    CompiledRule,
    Fields,
    KnownPlaces,
    RuleError,
    RuleProblem,
    compile_rule,
    dependency_problems,
    place_problems,
    source_problems,
    stream_problems,
)


class DetectorError(InputError, ValueError):
    """A Detector that cannot run; `problems` lists the reasons."""

    def __init__(self, problems: Iterable[RuleProblem]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(map(str, self.problems)))


@dataclass(frozen=True, slots=True)
class StreamReaders:
    """The inputs of a Detector's streams: how to read their payloads and keys, and the fields of their messages."""

    decoders: Mapping[str, Decoder]
    read_key: KeyReader
    fields: Mapping[str, Fields]
    types: RosTypes
    places: KnownPlaces
    """The places that rules can name, including those of map files."""


@dataclass(frozen=True, slots=True)
class RefusedRule:
    """A rejected rule, with the reason."""

    rule: EventRule
    problems: tuple[RuleProblem, ...]
    kept: bool
    """Whether its last good version stays in use."""

    def __str__(self) -> str:
        kept = "; keeping its last good version" if self.kept else ""
        return f"EventRule {self.rule.name} is refused{kept}: {'; '.join(map(str, self.problems))}"


def stream_readers(detector: Detector) -> StreamReaders:
    """Decoders and key readers for the Detector's streams.

    Raises:
        DetectorError: a key that is not in key-format notation, an unknown or invalid message type, or an invalid
            expression.
    """
    types, problems = message_types(detector.spec.messages)
    defined = {message.name for message in detector.spec.messages}
    decoders: dict[str, Decoder] = {}
    fields: dict[str, Fields] = {}
    asn1 = _asn1(detector, problems)
    for index, stream in enumerate(detector.spec.streams):
        known: Fields | None = None
        try:
            decoder = decoders[stream.name] = codec_for(stream, types=types, asn1=asn1)
        except UnknownTypeError as error:
            if stream.type not in defined:  # otherwise the problem of its definition is known
                problems.append(RuleProblem(("spec", "streams", index, "type"), str(error)))
        except DefinitionError as error:
            if asn1 is not None or not detector.spec.asn1:  # otherwise the problem of the modules is reported already
                field = "encoding" if stream.type is None else "type"
                problems.append(RuleProblem(("spec", "streams", index, field), str(error)))
        else:
            known = decoder.fields if isinstance(decoder, EtsiDecoder) else message_fields(stream, types)
        if known is not None:
            fields[stream.name] = known
        problems += stream_problems(stream, index, known)
    problems += source_problems(detector)
    problems += place_problems(detector)
    places, of_maps = known_places(detector)
    problems += of_maps
    if problems:
        raise DetectorError(problems)
    patterns = {stream.name: KeyPattern.parse(stream.key) for stream in detector.spec.streams}
    clients = {stream.name: stream.client for stream in detector.spec.streams}
    by_message = {stream.name for stream in detector.spec.streams if stream.names_by_message}
    if detector.spec.zenoh.liveliness is not None:
        patterns[LIVELINESS], clients[LIVELINESS] = KeyPattern.parse(detector.spec.zenoh.liveliness), None

    def read_key(stream: str, key: str) -> tuple[str, Mapping[str, str]] | None:
        pattern = patterns.get(stream)
        captures = None if pattern is None else pattern.match(key)
        if captures is None:
            return None
        if stream in by_message:
            return "", captures
        client = clients[stream] or captures["client"]
        return (client, captures) if CLIENT_NAME.fullmatch(client) else None

    return StreamReaders(decoders, read_key, fields, types, places)


def detector_problems(detector: Detector) -> tuple[RuleProblem, ...]:
    """The problems that keep the Detector from running; reads the files that it names."""
    try:
        stream_readers(detector)
    except DetectorError as error:
        return error.problems
    return ()


def lasting_problems(detector: Detector) -> tuple[RuleProblem, ...]:
    """The problems of its streams that no recording can solve: recordings may contain types and their fields."""
    return tuple(
        problem
        for index, stream in enumerate(detector.spec.streams)
        for problem in stream_problems(stream, index, message_fields(stream) if stream.type is None else None)
    )


def message_types(messages: Sequence[MessageDefinition]) -> tuple[RosTypes, list[RuleProblem]]:
    """The message types that a Detector knows; without its own definitions if these have problems."""
    try:
        return types_with(tuple(Definition(message.name, message.definition) for message in messages)), []
    except DefinitionsError as error:
        places = {message.name: index for index, message in enumerate(messages)}
        return standard(), [
            RuleProblem(("spec", "messages", places[name], "definition"), text) for name, text in error.problems
        ]


def _asn1(detector: Detector, problems: list[RuleProblem]) -> OwnDefinitions | None:
    """The ASN.1 modules of the Detector; their problems are appended to `problems`."""
    texts: list[str] = []
    for index, module in enumerate(detector.spec.asn1):
        try:
            texts.append(read_module(module))
        except DefinitionError as error:
            field = "file" if module.definition is None else "definition"
            problems.append(RuleProblem(("spec", "asn1", index, field), str(error)))
    if not texts or len(texts) < len(detector.spec.asn1):
        return None
    try:
        return own_definitions(tuple(texts))
    except DefinitionError as error:
        problems.append(RuleProblem(("spec", "asn1"), str(error)))
        return None


def offer_problems(rule: EventRule, detector: Detector) -> Iterator[RuleProblem]:
    """The problems of the installed packages that a rule uses: its plugin signals and its actions."""
    yield from plugin_problems(rule, detector)
    yield from action_problems(rule, detector)


class RuleIndex:
    """Compiles rules repeatedly. A rejected rule keeps its last good version, and never affects others.

    A typo in a rule that is being edited therefore ends no episode.
    """

    def __init__(self) -> None:
        self._good: dict[str, EventRule] = {}

    @property
    def good(self) -> list[EventRule]:
        """The rules to evaluate; for a rejected rule its last good version."""
        return list(self._good.values())

    def compile(
        self,
        rules: Sequence[EventRule],
        detector: Detector,
        fields: Mapping[str, Fields],
        places: KnownPlaces | None = None,
    ) -> tuple[list[CompiledRule], list[RefusedRule]]:
        """The rules to evaluate, and the rejected ones."""
        compiled: list[CompiledRule] = []
        refused: list[RefusedRule] = []
        good: dict[str, EventRule] = {}
        wrong = dependency_problems(rules)
        for rule in rules:
            try:
                known = (*wrong.get(rule.name, ()), *offer_problems(rule, detector))
                compiled.append(bind_models(compile_rule(rule, detector, fields, known, places)))
                good[rule.name] = rule
            except RuleError as error:
                before = self._good.get(rule.name)
                last = None if before is None else _compiled(before, detector, fields, places)
                refused.append(RefusedRule(rule, error.problems, kept=last is not None))
                if before is not None and last is not None:
                    compiled.append(last)
                    good[rule.name] = before
        self._good = good
        return compiled, refused


def _compiled(
    rule: EventRule, detector: Detector, fields: Mapping[str, Fields], places: KnownPlaces | None
) -> CompiledRule | None:
    """The rule, or None if the Detector no longer allows it."""
    try:
        return bind_models(compile_rule(rule, detector, fields, offer_problems(rule, detector), places))
    except RuleError:
        return None


def make_engine(
    detector: Detector,
    readers: StreamReaders,
    *,
    holder: str,
    start: int,
    plugins: PluginHost | None = None,
    order: int = ORDER,
) -> Engine:
    """An engine without rules; `start` is nanoseconds since the epoch. Without a host, plugins run in this process.

    `order`: see `steps.ORDER`.
    """
    return Engine(
        detector,
        holder=holder,
        decoders=readers.decoders,
        read_key=readers.read_key,
        start=start,
        plugins=plugins or LocalHost(),
        order=order,
    )
