"""Compiles a rule against the Detector that evaluates it, and reports all problems of the rule."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace

from wayside.api import Detector, EventRule
from wayside.api.base import JsonValue
from wayside.api.documents import FieldPath
from wayside.api.eventrule import Samples, Signal
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
from wayside.expressions.expanding import POSITION, NamedPlaces
from wayside.geo.geometry import Shape
from wayside.rules.actions import canonical_json, compile_actions, compile_deploys
from wayside.rules.compiled import (
    CompiledPlugin,
    CompiledRule,
    CompiledSignal,
    CompiledSubject,
    PairSubject,
    episode_stream,
)
from wayside.rules.derived import compile_derived, statistics_read
from wayside.rules.fields import Fields, unknown_fields
from wayside.rules.models import compile_models
from wayside.rules.naming import signal_name_problem
from wayside.rules.parameters import kinds_of, override_problems, parameters_of
from wayside.rules.places import KnownPlaces, located, of_conditions, of_samples, own_places
from wayside.rules.problems import RuleError, RuleProblem
from wayside.rules.scopes import (
    closing_speed_problem,
    compile_elements,
    compile_subject,
    element_problems,
    known_members,
    with_signals,
)
from wayside.rules.streams import item_fields
from wayside.rules.variables import (
    END_MEMBERS,
    EPISODE_MEMBERS,
    SAMPLE_MEMBERS,
    condition_environment,
    element_of,
    sample_environment,
)

_WITHOUT = {
    "item": "; item is for signals over streams with items, not over {}",
    "before": "; before is for signals over streams, not over a {}",
}
"""What samples do not have, by the variable."""


def compile_rule(
    rule: EventRule,
    detector: Detector,
    fields: Mapping[str, Fields] | None = None,
    known: Iterable[RuleProblem] = (),
    places: KnownPlaces | None = None,
) -> CompiledRule:
    """The rule as the engine evaluates it.

    `fields` has the message fields of the streams that are known to have no others; what an expression reads beside
    them is a problem. `known` has problems that were found beside it, among several rules. `places` are those that it
    can name; None: those that the Detector defines itself, and any other if it has maps.

    Raises:
        RuleError: with every problem of the rule.
    """
    compiler = _RuleCompiler(rule, detector, fields or {}, places or own_places(detector))
    compiler.problems += known
    compiled = compiler.compile()
    if compiler.problems or compiled is None:
        raise RuleError(compiler.problems)
    return compiled


class _RuleCompiler:
    """Goes through a rule once and collects the problems on the way."""

    def __init__(self, rule: EventRule, detector: Detector, fields: Mapping[str, Fields], places: KnownPlaces) -> None:
        self._written = rule
        self.rule = located(rule, detector)
        self.spec = self.rule.spec
        self.detector = detector
        self._places = places
        self._of_conditions = of_conditions(self.rule, places)
        self._used: dict[str, Shape] = {}
        self.fields = fields
        self.parameters = parameters_of(rule, detector)
        self._kinds = kinds_of(rule)
        self._knowing: dict[tuple[Environment, str | None], Environment] = {}
        self.problems = [
            RuleProblem(path, message, detector.name) for path, message in override_problems(rule, detector)
        ]

    def compile(self) -> CompiledRule | None:
        """The compiled rule, or None where problems forbid it."""
        subject = compile_subject(self)
        elements = compile_elements(self, self.spec.each)
        signals = [self._signal(index, signal) for index, signal in enumerate(self.spec.signals)]
        models = compile_models(self, [signal for signal in signals if signal is not None])
        plugins = [(each.name, each.plugin) for each in self.spec.signals if each.plugin is not None]
        if self.spec.evaluation.on_sample is not None:
            self.stream(("spec", "evaluation", "onSample"), self.spec.evaluation.on_sample)
        environment = condition_environment(self.spec)
        derived = compile_derived(self, environment)
        when = self.condition(("spec", "when"), self.spec.when, environment)
        until = self.condition(("spec", "until"), self.spec.until, environment)
        for field, condition in (("when", when), ("until", until)):
            for text in () if condition is None else statistics_read(condition, derived):
                self.problem(("spec", field), text)
        deploys = compile_deploys(self, enumerate(self.spec.actions), environment)
        actions = compile_actions(self, enumerate(self.spec.actions), environment)
        elements = with_signals(elements, element_of(self.spec), [each for each in signals if each is not None])
        for path, text in element_problems(elements, models):
            self.problem(path, text)
        if subject is not None:
            templates = [deploy.parameters for deploy in deploys]
            templates += [template for action in actions for template in action.templates.values()]
            embedded = [each.expression for template in templates for each in template.embedded]
            subject = self._closing(subject, (when, until, *(each.of for each in derived), *embedded))
        if self.problems or subject is None or when is None:
            return None
        spec = self.spec
        return CompiledRule(
            name=self.rule.name,
            subject=subject,
            signals=tuple(signal for signal in signals if signal is not None),
            plugins=tuple(CompiledPlugin(name, plugin.name, plugin.parameters) for name, plugin in plugins),
            when=when,
            until=until,
            every_ns=spec.evaluation.period_ns,
            for_ns=spec.for_.ns,
            cooldown_ns=spec.cooldown.ns,
            unknown_timeout_ns=(spec.unknown_timeout or self.detector.spec.client_timeout).ns,
            enabled=spec.enabled,
            dry_run=spec.dry_run,
            deploys=tuple(deploys),
            actions=tuple(actions),
            classification=None if spec.classification is None else spec.classification.to_json(),
            digest=_digest(self._written, self.rule, self.detector, self._used),
            places=tuple(self._used.values()),
            elements=elements,
            parameters=self.parameters,
            models=models,
            derived=derived,
            has_margin=spec.margin is not None,
            on_sample=spec.evaluation.on_sample,
            on_demand=bool(spec.evaluation.on_demand),
            priority=spec.evaluation.priority,
            maximum_per_hour=spec.max_episodes_per_hour,
        )

    def _signal(self, index: int, signal: Signal) -> CompiledSignal | None:
        at: FieldPath = ("spec", "signals", index)
        if (problem := signal_name_problem(signal.name, self.spec)) is not None:
            self.problem((*at, "name"), problem)
        if signal.rule_name is not None:
            return self._episode_signal(at, signal, signal.rule_name)
        if signal.stream is None:
            return None  # a model's or a plugin's, or computed from other signals
        stream = self.stream((*at, "stream"), signal.stream)
        value = self.sample((*at, "value"), signal.value, stream, CelType.DYN, element_of(self.spec))
        where = self.sample((*at, "where"), signal.where, stream, CelType.BOOL, element_of(self.spec))
        over = None if signal.over is None else signal.over.ns
        only = None if stream is None or stream.names_by_message else stream.client
        if only is not None and signal.client not in (None, only):
            self.problem((*at, "client"), f"stream {signal.stream} has only the client {only}: write client: {only}")
        if stream is not None and over is not None:
            kept = self.kept_ns(stream)
            if over > kept:
                self.problem(
                    (*at, "over"),
                    f"{signal.over} is longer than the {kept / 1e9:g} s that Detector {self.detector.name} keeps of "
                    f"stream {stream.name}: shorten it, or raise the stream's buffer.duration",
                )
        return CompiledSignal(
            signal.name, signal.stream, signal.aggregate, value, where, over, self.parameters,
            quantile=signal.quantile, client=signal.client,
        )  # fmt: skip

    def _episode_signal(self, at: FieldPath, signal: Signal, rule: str) -> CompiledSignal:
        """A signal whose samples are the episode starts or ends of another rule."""
        ends = signal.samples is Samples.ENDS
        value, where = (
            self.sample((*at, field), source, None, kind, element_of(self.spec), of_rule=True)
            for field, source, kind in (("value", signal.value, CelType.DYN), ("where", signal.where, CelType.BOOL))
        )
        for field, expression in (("value", value), ("where", where)):
            members = END_MEMBERS if ends else EPISODE_MEMBERS
            for text in () if expression is None else unknown_fields(expression.paths, "msg", members):
                self.problem((*at, field), f"{text} (msg is an episode's {'end' if ends else 'start'})")
        over = None if signal.over is None else signal.over.ns
        return CompiledSignal(
            signal.name, episode_stream(rule, ends=ends), signal.aggregate, value, where, over, self.parameters, rule,
            quantile=signal.quantile, client=signal.client,
        )  # fmt: skip

    def template(
        self, path: FieldPath, value: Mapping[str, JsonValue], environment: Environment
    ) -> CompiledTemplate | None:
        """Texts with ${…}, which stand at the path by name; None where one is wrong."""
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
        """The Detector's stream of that name; None, and a problem, where it has none."""
        stream = self.detector.spec.stream(name)
        if stream is None:
            names = [stream.name for stream in self.detector.spec.streams]
            close = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {close[0]}?" if close else f"it has {', '.join(names)}"
            self.problem(path, f"Detector {self.detector.name} has no stream {name}; {hint}")
        return stream

    def condition(
        self, path: FieldPath, source: str | None, environment: Environment, kind: CelType = CelType.BOOL
    ) -> Expression | None:
        """An expression over what a subject is seen as; None where there is none, or it is wrong."""
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
        """An expression over one sample, and the element's variable; None where there is none, or it is wrong.

        `of_rule`: the samples are those of a rule; else `stream` is None where the Detector has no such stream.
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
        if stream is not None and stream.name in self.fields:
            of_type = "" if stream.type is None else f", type {stream.type}"
            fields = self.fields[stream.name]
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
        """`whose` samples it is over: the stream's name, or `rule`."""
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
        self._used.update({shape.name: shape for shape in expression.places})

    def _typed(self, environment: Environment, places: NamedPlaces | None = None) -> Environment:
        """The environment, knowing of which kinds the rule's parameters are, and the places; None: of conditions."""
        key = environment, None if places is None else places.stream
        if key not in self._knowing:
            self._knowing[key] = environment.knowing(self._kinds).naming(places or self._of_conditions)
        return self._knowing[key]

    def kept_ns(self, stream: Stream) -> int:
        """How long the Detector keeps the stream's samples, in nanoseconds."""
        return self.detector.spec.buffer_duration_ns(stream)

    def _members(self, path: FieldPath, paths: Iterable[Path]) -> None:
        """A pair's a and b and the element of `each` are maps: CEL itself does not know what is in them."""
        for name, members in known_members(self.spec):
            for text in unknown_fields(paths, name, members):
                self.problem(path, text)

    def _closing(self, subject: CompiledSubject, conditions: Iterable[Expression | None]) -> CompiledSubject:
        """The subject, with the closing speed if any expression uses it."""
        if not isinstance(subject, PairSubject):
            return subject
        asking = [expression.names for expression in (*conditions, subject.where) if expression is not None]
        if not any("closingSpeed" in names for names in asking):
            return subject
        stream = self.detector.spec.stream(subject.position.stream)
        if stream is not None and (problem := closing_speed_problem(stream, self.kept_ns(stream))) is not None:
            self.problem(("spec", "scope", "pairs", "position", "stream"), problem)
        return replace(subject, closing_speed=True)

    def problem(self, path: FieldPath, message: str) -> None:
        """Report a problem with a field, once: a position that is written once is read by axes."""
        if (problem := RuleProblem(path, message)) not in self.problems:
            self.problems.append(problem)


def _parameter_of(located: InterpolationError | Embedded) -> str:
    """The parameter in which it stands, of a path such as `sources[0].name`."""
    return re.split(r"[.\[]", located.path, maxsplit=1)[0]


def _digest(written: EventRule, rule: EventRule, detector: Detector, places: Mapping[str, Shape]) -> str:
    """Of what decides which episodes there are, the Detector's values for the parameters and its places among it.

    `rule` has written out what the Detector knows of positions.
    """
    clients = {client.name: values for client in detector.spec.clients if (values := client.parameters.get(rule.name))}
    decisive: list[JsonValue] = [rule.semantics(), clients]
    if places or rule is not written:
        decisive.append(sorted(shape.key for shape in places.values()))
    decisive += [
        {stream.name: dict(stream.position.axes)}
        for stream in detector.spec.streams
        if stream.position is not None and any(POSITION in each for each in _of_stream(written, stream.name))
    ]
    return hashlib.sha256(canonical_json(decisive).encode()).hexdigest()[:16]


def _of_stream(rule: EventRule, stream: str) -> list[str]:
    """The expressions of the rule's signals over the stream."""
    signals = (signal for signal in rule.spec.signals if signal.stream == stream)
    return [each for signal in signals for each in (signal.value, signal.where) if each is not None]
