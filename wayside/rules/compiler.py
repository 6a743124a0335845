"""Compiles the expressions of a rule against its Detector, and collects the problems of the rule."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

from wayside.api import Detector, EventRule
from wayside.api.base import JsonValue
from wayside.api.documents import FieldPath
from wayside.api.stream import Stream
from wayside.expressions import (
    CelType,
    CompiledTemplate,
    Embedded,
    Environment,
    Expression,
    ExpressionError,
    InterpolationError,
    Path,
    compile_template,
)
from wayside.expressions.expanding import NamedPlaces
from wayside.geo.geometry import Shape
from wayside.names import did_you_mean
from wayside.rules.fields import Fields, unknown_fields
from wayside.rules.parameters import kinds_of, override_problems, parameters_of
from wayside.rules.places import KnownPlaces, located, of_conditions, of_samples
from wayside.rules.problems import RuleProblem
from wayside.rules.streams import item_fields
from wayside.rules.variables import SAMPLE_MEMBERS, known_members, sample_environment

_WITHOUT = {
    "item": "; item is for signals over streams with items, not over {}",
    "before": "; before is for signals over streams, not over a {}",
}
"""Hints by variable, for variables that some samples do not have."""


class Compiler:
    """One rule and its Detector. The parts of the rule are compiled with it, and report their problems to it."""

    def __init__(self, rule: EventRule, detector: Detector, fields: Mapping[str, Fields], places: KnownPlaces) -> None:
        self.written = rule
        self.rule = located(rule, detector)
        """The rule, completed with the positions of the Detector."""
        self.spec = self.rule.spec
        self.detector = detector
        self._places = places
        self._of_conditions = of_conditions(self.rule, places)
        self.used: dict[str, Shape] = {}
        """The places that the expressions name, by name."""
        self._fields = fields
        self.parameters = parameters_of(rule, detector)
        self._kinds = kinds_of(rule)
        self._knowing: dict[tuple[Environment, str | None], Environment] = {}
        self.problems = [
            RuleProblem(path, message, detector.name) for path, message in override_problems(rule, detector)
        ]

    def template(
        self, path: FieldPath, value: Mapping[str, JsonValue], environment: Environment
    ) -> CompiledTemplate | None:
        """The compiled values with ${…}, whose names follow the path; None if one is invalid."""
        try:
            compiled = compile_template(dict(value), self._typed(environment))
        except InterpolationError as error:
            for each in (error, *error.others):
                self.problem((*path, _parameter_of(each)), str(each))
            return None
        for embedded in compiled.embedded:
            self._use(embedded.expression)
            self._members((*path, _parameter_of(embedded)), embedded.expression.paths)
        return compiled

    def stream(self, path: FieldPath, name: str) -> Stream | None:
        """The Detector's stream of that name; None, with a problem, if it has none."""
        stream = self.detector.spec.stream(name)
        if stream is None:
            names = [stream.name for stream in self.detector.spec.streams]
            hint = did_you_mean(name, names) or f"it has {', '.join(names)}"
            self.problem(path, f"Detector {self.detector.name} has no stream {name}; {hint}")
        return stream

    def condition(
        self, path: FieldPath, source: str | None, environment: Environment, kind: CelType = CelType.BOOL
    ) -> Expression | None:
        """An expression over the variables of a subject; None if there is none, or it is invalid."""
        expression = self._expression(path, source, environment, kind)
        if expression is not None:
            self._members(path, expression.paths)
        return expression

    def sample(
        self,
        path: FieldPath,
        source: str | None,
        stream: Stream | None,
        kind: CelType,
        element: str | None = None,
        *,
        of_rule: bool = False,
    ) -> Expression | None:
        """An expression over one sample and the element's variable; None if there is none, or it is invalid.

        `of_rule`: the samples are those of a rule; otherwise, `stream` is None if the Detector has no such stream.
        """
        items = not of_rule and (stream is None or stream.items is not None)
        environment = sample_environment(element, items=items, before=not of_rule)
        whose = "rule" if stream is None else stream.name
        expression = self._expression(path, source, environment, kind, of_samples(stream, self._places), whose)
        if expression is None:
            return None
        if element is not None:
            self._members(path, expression.paths)
        of_sample: Fields = dict.fromkeys(SAMPLE_MEMBERS)
        for variable, members in (("sample", of_sample), ("parameters", dict.fromkeys(self.spec.parameters))):
            for text in unknown_fields(expression.paths, variable, members):
                self.problem(path, text)
        if stream is not None and stream.name in self._fields:
            of_type = "" if stream.type is None else f", type {stream.type}"
            fields = self._fields[stream.name]
            of_items = item_fields(stream, fields) or {}
            before = fields if stream.items is None else of_items
            for variable, known in (("msg", fields), ("item", of_items), ("before", before)):
                for text in unknown_fields(expression.paths, variable, known) if known else ():
                    self.problem(path, f"{text} (stream {stream.name}{of_type})")
        return expression

    def _expression(
        self,
        path: FieldPath,
        source: str | None,
        environment: Environment,
        kind: CelType,
        places: NamedPlaces | None = None,
        whose: str = "",
    ) -> Expression | None:
        """`whose`: the source of its samples, a stream's name or `rule`; empty without samples."""
        if source is None:
            return None
        try:
            expression = self._typed(environment, places).compile(source, result=kind)
        except ExpressionError as error:
            for each in (error, *error.others):
                without = [text for name, text in _WITHOUT.items() if whose and f"`{name}` is not" in str(each)]
                self.problem(path, f"{each}{''.join(without).format(whose)}")
            return None
        self._use(expression)
        return expression

    def _use(self, expression: Expression) -> None:
        self.used |= {shape.name: shape for shape in expression.places}

    def _typed(self, environment: Environment, places: NamedPlaces | None = None) -> Environment:
        """The environment with the types of the rule's parameters, and the places; None: those of conditions."""
        key = environment, None if places is None else places.stream
        if key not in self._knowing:
            self._knowing[key] = environment.knowing(self._kinds).naming(places or self._of_conditions)
        return self._knowing[key]

    def retention_ns(self, stream: Stream) -> int:
        """How long the Detector keeps the stream's samples, in nanoseconds."""
        return self.detector.spec.buffer_duration_ns(stream)

    def exceeds_retention(self, path: FieldPath, problem: str, stream: Stream) -> None:
        """Report a time that exceeds the buffer duration of a stream. The message begins with `problem`."""
        self.problem(
            path,
            f"{problem} the {self.retention_ns(stream) / 1e9:g} s that Detector {self.detector.name} keeps of stream "
            f"{stream.name}: shorten it, or raise the stream's buffer.duration",
        )

    def _members(self, path: FieldPath, paths: Iterable[Path]) -> None:
        """Check the fields of a pair's a and b, and of the element of `each`: CEL does not check maps."""
        for name, members in known_members(self.spec):
            for text in unknown_fields(paths, name, members):
                self.problem(path, text)

    def problem(self, path: FieldPath, message: str) -> None:
        """Report a problem with a field, only once: a position that is used once is read once per axis."""
        if (problem := RuleProblem(path, message)) not in self.problems:
            self.problems.append(problem)


def _parameter_of(located: InterpolationError | Embedded) -> str:
    """The parameter that contains it, from a path such as `sources[0].name`."""
    return re.split(r"[.\[]", located.path, maxsplit=1)[0]
